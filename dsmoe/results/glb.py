"""Binary glTF with Khronos' extension KHR_gaussian_splatting, written and read; its viewers blend by alpha."""
from __future__ import annotations

import json
import struct
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

import numpy as np

from diff_smoe_rasterization._version import __version__
from diff_smoe_rasterization.io import Gaussians

from ..errors import TrainerError
from ..scenes.pointcloud import SH_C0
from .shown import FAINT_BELOW, logits, rotatable_rows, sigmoid, y_up

SPLATTING = "KHR_gaussian_splatting"
BLEND = "DSMOE_gaussian_splatting_blend"
"""The extension of models that are not blended by alpha: `blendMode`, `backgroundGate`, and `faintBelow` where that
is not as usual. It is required, so that a viewer that does not know it refuses the file."""

POINTS, VERTICES = 0, 34962  # of glTF: a primitive's mode, a buffer view's target
FLOAT, UNSIGNED_SHORT = 5126, 5123  # component types
SRGB = "srgb_rec709_display"
UNMOVED = {"matrix": np.eye(4).ravel().tolist(), "translation": [0, 0, 0], "rotation": [0, 0, 0, 1],
           "scale": [1, 1, 1]}  # what nodes have that move nothing
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
LARGEST = 2**32 - 1  # bytes of a .glb, whose length has 32 bits


class Blend(NamedTuple):
    """How a pixel is made."""

    mode: str  # one of BLEND_MODES
    background_gate: float
    faint_below: Optional[float] = None  # as usual


def glb_bytes(gaussians: Gaussians, blend: Optional[Blend]) -> bytes:
    """The file's content, in the axes of glTF (y up). blend: None for alpha.

    Left out are Gaussians that are not finite, and those whose quaternion is 0. Raises TrainerError if none is left,
    and if they are too many.
    """
    attributes = _attributes(gaussians, fallback=blend is None)
    count = len(attributes["POSITION"])
    document, offset = _document(blend), 0
    for index, (name, array) in enumerate(attributes.items()):
        document["bufferViews"].append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes,
                                        "target": VERTICES})
        document["accessors"].append({"bufferView": index, "type": TYPES[array.shape[1]], "count": count,
                                      **_component(array)})
        document["meshes"][0]["primitives"][0]["attributes"][name] = index
        offset += array.nbytes
    positions = attributes["POSITION"]
    document["accessors"][0].update(min=positions.min(axis=0).tolist(), max=positions.max(axis=0).tolist())
    document["buffers"] = [{"byteLength": offset}]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + offset
    if length > LARGEST:
        raise TrainerError(f"a .glb has 4 GiB at most, but {count:,} Gaussians take {length:,} bytes; a lower "
                           "--sh-degree makes it smaller")
    return b"".join([struct.pack("<4sII", b"glTF", 2, length), struct.pack("<I4s", len(text), b"JSON"), text,
                     struct.pack("<I4s", offset, b"BIN\0"), *(array.tobytes() for array in attributes.values())])


def glb_gaussians(content: bytes) -> Gaussians:
    """What a file holds: one primitive of Gaussians, in float32, where it lies. Raises ValueError for another."""
    header = struct.Struct("<4s2II4s")
    if len(content) < header.size:
        raise ValueError(f"not a .glb of Gaussians: it has {len(content)} bytes, of {header.size} at least")
    magic, _, _, length, kind = header.unpack_from(content)
    if (magic, kind) != (b"glTF", b"JSON"):
        raise ValueError("it is not a binary glTF")
    if len(content) < header.size + length:
        raise ValueError(f"not a .glb of Gaussians: it has {len(content)} bytes, but its JSON ends at byte "
                         f"{header.size + length} (truncated file?)")
    try:
        document, binary = _json(content[20:20 + length]), content[28 + length:]
        primitives = [primitive for mesh in document["meshes"] for primitive in mesh["primitives"]
                      if SPLATTING in primitive.get("extensions", {})]
        if not primitives:
            raise ValueError(f"it holds no Gaussians of {SPLATTING}")
        _refuse_what_is_not_read(document, primitives)
        blend = primitives[0]["extensions"][SPLATTING].get("extensions", {}).get(BLEND, {})
        arrays = {name: _read(document, binary, index) for name, index in primitives[0]["attributes"].items()
                  if name != "COLOR_0"}
        _check_shapes(arrays)
        position, harmonics = arrays["POSITION"], []
        for degree in range(4):
            names = [f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{place}" for place in range(2 * degree + 1)]
            if not all(name in arrays for name in names):
                break
            harmonics += [arrays[name] for name in names]
        with np.errstate(divide="ignore", invalid="ignore"):
            log_scales = np.log(arrays[f"{SPLATTING}:SCALE"])
        gaussians = Gaussians(
            means3D=position, dc=harmonics[0][:, None],
            shs=np.stack(harmonics[1:], 1) if harmonics[1:] else np.zeros((len(position), 0, 3), np.float32),
            opacity_logits=logits(arrays[f"{SPLATTING}:OPACITY"]).astype(np.float32), log_scales=log_scales,
            rotations=arrays[f"{SPLATTING}:ROTATION"][:, [3, 0, 1, 2]],
            blend_mode=blend.get("blendMode", "alpha"), background_gate=blend.get("backgroundGate"),
            comments=(f"{FAINT_BELOW} {blend['faintBelow']}",) if "faintBelow" in blend else ())
    except KeyError as error:
        raise ValueError(f"not a .glb of Gaussians: it has no {error}") from error
    except (IndexError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"not a .glb of Gaussians ({error})") from error
    return y_up(gaussians)


def _refuse_what_is_not_read(document: Dict[str, Any], primitives: List[Dict[str, Any]]) -> None:
    """Raises ValueError if the Gaussians would be other ones, or in another place, than viewers show them."""
    if len(primitives) > 1:
        raise ValueError(f"it holds {len(primitives)} clouds of Gaussians; only a file of one is read")
    space = primitives[0]["extensions"][SPLATTING].get("colorSpace", SRGB)
    if space != SRGB:
        raise ValueError(f"its Gaussians have the colour space {space!r}; only {SRGB} is read")
    nodes = document.get("nodes", [])
    above = {child: place for place, node in enumerate(nodes) for child in node.get("children", [])}
    for place, node in enumerate(nodes):
        mesh = document["meshes"][node["mesh"]] if "mesh" in node else {"primitives": []}
        if primitives[0] not in mesh["primitives"]:
            continue
        seen = set()
        while place is not None and place not in seen:
            seen.add(place)
            for name, identity in UNMOVED.items():
                if nodes[place].get(name, identity) != identity:
                    raise ValueError(f"its node {place} moves the Gaussians by a {name}, which is not read; write it "
                                     "without")
            place = above.get(place)


def _json(text: bytes) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise ValueError(f"not a .glb of Gaussians: its JSON is not valid ({error})") from error


def _read(document: Dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    """An accessor of float32, [N, width]. Raises ValueError for another type, and for one that is not there."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {name: width for width, name in TYPES.items()}[accessor["type"]]
    if accessor["componentType"] != FLOAT or view.get("byteStride", 4 * width) != 4 * width:
        raise ValueError("its Gaussians are not in float32 without gaps; only such are read")
    offset, count = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), accessor["count"]
    if not (isinstance(count, int) and 0 <= count and 0 <= offset and offset + 4 * width * count <= len(binary)):
        raise ValueError(f"accessor {index} has {count} rows of {width} numbers from byte {offset} on, but the file "
                         f"holds {len(binary)} bytes of them (truncated file?)")
    return np.frombuffer(binary, "<f4", count * width, offset).reshape(-1, width)


def _check_shapes(arrays: Dict[str, np.ndarray]) -> None:
    """Raises ValueError if an attribute of the Gaussians has not one row of the right width for each of them."""
    widths = {"POSITION": 3, f"{SPLATTING}:ROTATION": 4, f"{SPLATTING}:SCALE": 3, f"{SPLATTING}:OPACITY": 1}
    for name, array in arrays.items():
        wanted = (len(arrays["POSITION"]), widths.get(name, 3))
        if name in widths or name.startswith(f"{SPLATTING}:SH_DEGREE_"):
            if array.shape != wanted:
                raise ValueError(f"{name} has {array.shape[0]} rows of {array.shape[1]} numbers; it must have "
                                 f"{wanted[0]} of {wanted[1]}")


def _document(blend: Optional[Blend]) -> Dict[str, Any]:
    """The JSON without what depends on the arrays."""
    splatting: Dict[str, Any] = {"kernel": "ellipse", "colorSpace": SRGB}
    document: Dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"diff_smoe_rasterization {__version__}"},
        "extensionsUsed": [SPLATTING],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": POINTS, "attributes": {}, "extensions": {SPLATTING: splatting}}]}],
        "accessors": [], "bufferViews": [],
    }
    if blend:
        said: Dict[str, Any] = {"blendMode": blend.mode, "backgroundGate": blend.background_gate}
        if blend.faint_below is not None:
            said["faintBelow"] = blend.faint_below
        splatting["extensions"] = {BLEND: said}
        document["extensionsUsed"].append(BLEND)
        document["extensionsRequired"] = [SPLATTING, BLEND]
    return document


def _attributes(gaussians: Gaussians, fallback: bool) -> Dict[str, np.ndarray]:
    """By name, the position first: [N, 1], [N, 3] or [N, 4], of 4 bytes or a multiple a row.

    fallback: with colours for viewers that know no Gaussians and show points.
    """
    position, logit, log_scales, rotations, dc, harmonics = rotatable_rows(y_up(gaussians))
    opacity = sigmoid(logit)
    scales = np.exp(log_scales.astype(np.float64)).clip(max=np.finfo(np.float32).max)
    unit = rotations / np.linalg.norm(rotations.astype(np.float64), axis=1, keepdims=True)
    attributes = {"POSITION": position, f"{SPLATTING}:ROTATION": unit[:, [1, 2, 3, 0]], f"{SPLATTING}:SCALE": scales,
                  f"{SPLATTING}:OPACITY": opacity, f"{SPLATTING}:SH_DEGREE_0_COEF_0": dc}
    for index, (degree, place) in enumerate(_coefficients(gaussians.sh_degree)):
        attributes[f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{place}"] = harmonics[:, 3 * index:3 * index + 3]
    arrays = {name: np.ascontiguousarray(array, "<f4") for name, array in attributes.items()}
    if fallback:
        linear = _linear((0.5 + SH_C0 * dc.astype(np.float64)).clip(0, 1))
        arrays["COLOR_0"] = np.rint(np.hstack([linear, opacity]) * 65535).astype("<u2")
    return arrays


def _coefficients(sh_degree: int) -> List[Tuple[int, int]]:
    """(degree, place in it) of the harmonics from degree 1 on, in the order of a .ply, which is glTF's."""
    return [(degree, place) for degree in range(1, sh_degree + 1) for place in range(2 * degree + 1)]


def _component(array: np.ndarray) -> Dict[str, Any]:
    return {"componentType": FLOAT} if array.dtype == np.float32 else {
        "componentType": UNSIGNED_SHORT, "normalized": True}


def _linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] to linear, IEC 61966-2-1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
