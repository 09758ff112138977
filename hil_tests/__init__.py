"""The whole chain on real SocketCAN: tests marked `vcan`, and the runner that gives them vcan0 and vcan1 anywhere."""
