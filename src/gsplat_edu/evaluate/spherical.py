"""Metadata of 360-degree images and videos, so that players show them as a sphere to look around in.

A PNG has a packet of XMP with the names of Google's Photo Sphere, a video the boxes of Spherical Video V2 at the end of
its sample entry:

    st3d: not stereoscopic
    sv3d: svhd (the program), proj: prhd (yaw, pitch, roll), equi (the part of the sphere: all of it)
"""

from __future__ import annotations

import struct

from gsplat_edu.base.errors import ArgumentError

XMP_KEY = "XML:com.adobe.xmp"
"""Keyword of the PNG chunk of XMP."""

PROGRAM = b"gsplat_edu"

PATH = (b"trak", b"mdia", b"minf", b"stbl", b"stsd")
"""The boxes that contain the sample entry, from the outside to the inside, within the index."""

TABLE_HEADER = 8
"""Bytes of version, flags and count before the entries of stsd."""


def photo_sphere(W: int, H: int) -> str:
    """Return the XMP packet of an equirectangular image that shows the whole sphere.

    Args:
        W: Width, px.
        H: Height, px.
    """
    values = {
        "ProjectionType": "equirectangular",
        "UsePanoramaViewer": "True",
        "FullPanoWidthPixels": W,
        "FullPanoHeightPixels": H,
        "CroppedAreaImageWidthPixels": W,
        "CroppedAreaImageHeightPixels": H,
        "CroppedAreaLeftPixels": 0,
        "CroppedAreaTopPixels": 0,
    }
    listed = "\n".join(f'   GPano:{name}="{value}"' for name, value in values.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"\n'
        f"{listed}/>\n"
        " </rdf:RDF>\n"
        "</x:xmpmeta>\n"
        '<?xpacket end="r"?>'
    )


def sphere_boxes() -> bytes:
    """Return st3d and sv3d of an equirectangular video that shows the whole sphere, level and not turned."""
    whole = bytes(4)  # version and flags
    equi = _box(b"equi", whole + struct.pack(">4I", 0, 0, 0, 0))
    prhd = _box(b"prhd", whole + struct.pack(">3i", 0, 0, 0))
    svhd = _box(b"svhd", whole + PROGRAM + b"\0")
    return _box(b"st3d", whole + b"\0") + _box(b"sv3d", svhd + _box(b"proj", prhd + equi))


def _box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def as_sphere(index: bytes | bytearray) -> bytearray:
    """Append `sphere_boxes` to the sample entry of an MP4 file's index, which grows by their length.

    Offsets of frames behind the index have to be moved by the caller.

    Args:
        index: The box moov, with one track of one sample entry.

    Raises:
        ArgumentError: a box on the way to the sample entry is missing.
    """
    found, added = bytearray(index), sphere_boxes()
    start, end, content = 0, len(found), 8
    around = [start]
    for kind in PATH:
        start, end = _child(found, kind, content, end)
        around.append(start)
        content = start + 8
    entry = start + 8 + TABLE_HEADER
    (length,) = struct.unpack_from(">I", found, entry)
    if entry + length != end:
        raise ArgumentError("video: its track has no single sample entry; write a folder instead")
    for box in (*around, entry):
        (length,) = struct.unpack_from(">I", found, box)
        struct.pack_into(">I", found, box, length + len(added))
    found[end:end] = added
    return found


def _child(data: bytearray, wanted: bytes, at: int, end: int) -> tuple[int, int]:
    """Return start and end of a box's first child of a kind."""
    while at + 8 <= end:
        length, kind = struct.unpack_from(">I4s", data, at)
        if length < 8 or at + length > end:
            break
        if kind == wanted:
            return at, at + length
        at += length
    raise ArgumentError(f"video: its index has no {wanted.decode()} box; write a folder instead")
