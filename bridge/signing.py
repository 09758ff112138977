"""How level 2 signs a command (see `wire.Command`); the gate checks what is made here."""
from __future__ import annotations

import base64

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from bridge import wire


def signed(order: wire.Order, fleet: str, key: str, private: Ed25519PrivateKey) -> wire.Command:
    """The command that carries an order to its unit, signed by a key of that name."""
    body = wire.encode(order).decode()
    signature = private.sign(wire.signed_bytes(fleet, order.unit, body))
    return wire.Command(key=key, body=body, signature=base64.b64encode(signature).decode())
