"""The programs of the nodes on the bus, each a protocol and the physical plant behind it. Level 1 meets them on the wire only."""
