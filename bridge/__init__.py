"""The way to level 2: wire messages, durable outbox, MQTT session, command gate (DESIGN §6)."""
