"""A reference receiver for what units send: stores, acknowledges, commands."""
