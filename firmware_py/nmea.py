"""What a GNSS receiver with two antennas says on its serial line: GGA, RMC, VTG and HDT (NMEA 0183, IEC 61162-1)."""
from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

KNOT_KMH = 1.852
FIXES = {"NoFix": 0, "Single": 1, "Dgps": 2, "RtkFixed": 4, "RtkFloat": 5}
_MODES = {"NoFix": "N", "Single": "A", "Dgps": "D", "RtkFixed": "R", "RtkFloat": "F"}
_START = datetime(1970, 1, 1, tzinfo=UTC)


def sentences(utc_ns: int, latitude_deg: float, longitude_deg: float, heading_deg: float, speed_kmh: float,
              fix: str, altitude_m: float) -> Iterator[bytes]:
    """The sentences of one moment, each with its checksum and end of line. fix: one of `FIXES`; without one, fields are empty."""
    moment = _START + timedelta(microseconds=utc_ns // 1000)
    time = moment.strftime("%H%M%S.") + f"{moment.microsecond // 10_000:02d}"
    has_fix = fix != "NoFix"
    place = f"{_angle(latitude_deg, 2, 'NS')},{_angle(longitude_deg, 3, 'EW')}" if has_fix else ",,,"
    course = f"{heading_deg % 360:.2f}" if has_fix else ""
    knots = f"{speed_kmh / KNOT_KMH:.3f}" if has_fix else ""
    accuracy = ("14,0.8," + f"{altitude_m:.3f},M,50.000,M,1.0,0001") if has_fix else "00,99.9,,M,,M,,"
    yield sentence(f"GNGGA,{time},{place},{FIXES[fix]},{accuracy}")
    yield sentence(f"GNRMC,{time},{'A' if has_fix else 'V'},{place},{knots},{course},{moment.strftime('%d%m%y')},,,{_MODES[fix]}")
    yield sentence(f"GNVTG,{course},T,,M,{knots},N,{f'{speed_kmh:.3f}' if has_fix else ''},K,{_MODES[fix]}")
    yield sentence(f"GNHDT,{course},T")


def sentence(body: str) -> bytes:
    """`$BODY*HH` and the end of the line."""
    checksum = 0
    for byte in body.encode("ascii"):
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n".encode("ascii")


def _angle(degrees: float, digits: int, signs: str) -> str:
    whole, tenmillionths = divmod(round(abs(degrees) * 60e7), 60 * 10**7)
    return f"{whole:0{digits}d}{tenmillionths / 1e7:010.7f},{signs[degrees < 0]}"
