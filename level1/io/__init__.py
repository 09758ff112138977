"""The only modules of level 1 that touch the world: CAN, files, the journal, the live loop, replay."""
