"""Files of Gaussian models, point clouds and COLMAP scenes, as numpy arrays.

The formats are read and written by the C++ core (csrc/io). A missing file raises FileNotFoundError (another OSError
if it is there and cannot be read), malformed content ValueError; both name the file, ValueError also byte or line.
"""
from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np

PathLike = Union[str, "os.PathLike[str]"]


def _io() -> Any:
    """The compiled readers and writers. They load at the first use: `dsmoe scene` needs only the records below."""
    from .core import _core

    return _core.io


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A model of N Gaussians as Inria's 3DGS stores it: float32, before sigmoid, exp and normalisation.

    K = (sh_degree + 1)^2 is the number of SH coefficients per channel.
    """

    means3D: np.ndarray  # [N, 3] world
    dc: np.ndarray  # [N, 1, 3] SH coefficient 0
    shs: np.ndarray  # [N, K-1, 3] SH coefficients 1 to K-1
    opacity_logits: np.ndarray  # [N, 1]; opacity = sigmoid
    log_scales: np.ndarray  # [N, 3]; scale = exp
    rotations: np.ndarray  # [N, 4] (w, x, y, z), not normalised
    blend_mode: Optional[str] = None  # that the model was trained with; None if the file does not say
    background_gate: Optional[float] = None  # lambda of `smoe` and `smoe_eq7`, from the .ply's comments
    comments: Tuple[str, ...] = ()  # comment lines of the file, those that record mode and gate included

    @property
    def sh_degree(self) -> int:
        """0 to 3, from the number of coefficients."""
        return _sh_degree("Gaussians", self.shs)


@dataclass(frozen=True, eq=False)
class Points:
    """A cloud of N points."""

    positions: np.ndarray  # [N, 3] float64, world, finite
    colors: Optional[np.ndarray] = None  # [N, 3] uint8 red, green, blue; None if there are none
    normals: Optional[np.ndarray] = None  # [N, 3] float32; None if there are none
    comments: Tuple[str, ...] = ()  # comment lines of a PLY file


@dataclass(frozen=True, eq=False)
class ColmapCamera:
    """Intrinsics, in the camera model's own order: PINHOLE has fx, fy, cx, cy; SIMPLE_PINHOLE f, cx, cy."""

    id: int
    model: str  # COLMAP's name, such as "PINHOLE"
    width: int  # pixels
    height: int
    params: np.ndarray  # float64, finite; lengths in pixels, the centre of the first pixel at 0.5


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A posed image: x_camera = R(qvec) x_world + tvec."""

    id: int
    name: str  # path below the folder of images
    camera_id: int
    qvec: np.ndarray  # [4] float64 (w, x, y, z), of unit length when read
    tvec: np.ndarray  # [3] float64


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model without its 2D observations and tracks."""

    cameras: Dict[int, ColmapCamera]  # by id
    images: List[ColmapImage]  # in the file's order; every camera_id is in cameras
    points: Points
    point_errors: Optional[np.ndarray] = None  # [N] float64, mean reprojection error in pixels
    folder: str = ""  # where it was found


def read_gaussians(path: PathLike) -> Gaussians:
    """Reads an Inria-format .ply of SH degree 0 to 3: ascii or binary, columns in any order and scalar type.

    NaN and infinities are returned as they are. Raises OSError; ValueError for malformed content, a missing column,
    comments that record two different blend modes or background gates, or a gate that is none.
    """
    return Gaussians(**_io().read_gaussians(os.fsencode(path)))


def write_gaussians(path: PathLike, gaussians: Gaussians) -> None:
    """Writes an Inria-format .ply (binary little endian, float32, zero normals).

    `comment blend_mode NAME` and `comment background_gate VALUE` record what is not None; the value is read back
    exactly.
    The arrays may be anything that numpy.asarray takes. The file appears under its name only when it is complete.
    Raises OSError; ValueError naming the array, its shape and the shape it must have, and for comments that record
    another mode or gate.
    """
    g = gaussians
    count = np.shape(g.means3D)[0] if np.ndim(g.means3D) else 0
    sh_degree = _sh_degree("write_gaussians", g.shs)
    shapes = {
        "means3D": (count, 3),
        "dc": (count, 1, 3),
        "shs": (count, (sh_degree + 1) ** 2 - 1, 3),
        "opacity_logits": (count, 1),
        "log_scales": (count, 3),
        "rotations": (count, 4),
    }
    arrays = [_array("write_gaussians", name, getattr(g, name), np.float32, shape) for name, shape in shapes.items()]
    _io().write_gaussians(os.fsencode(path), sh_degree, *arrays, g.blend_mode or "", g.background_gate,
                          list(g.comments))


def read_points(path: PathLike) -> Points:
    """Reads a .ply point cloud: x y z and, if present, red green blue (0 to 255) and nx ny nz.

    Raises OSError; ValueError for malformed content and for a position that is NaN or infinite.
    """
    return Points(**_io().read_points(os.fsencode(path)))


def write_points(path: PathLike, points: Points) -> None:
    """Writes a .ply point cloud: positions and normals as float32, colours as uchar.

    Raises OSError; ValueError naming the array, its shape and the shape it must have.
    """
    positions, colors = _cloud("write_points", points)
    normals = _optional_array("write_points", "normals", points.normals, np.float32, (len(positions), 3))
    _io().write_points(os.fsencode(path), positions, colors, normals, list(points.comments))


def read_colmap(folder: PathLike) -> ColmapModel:
    """Reads the sparse model in folder, folder/sparse/0 or folder/sparse, the first of these that has one.

    Binary files are preferred to text files. Raises FileNotFoundError naming what was looked for; ValueError for
    malformed content, a model without cameras or images, and an image whose camera is not there.
    """
    found = _io().find_colmap_folder(os.fsencode(folder))
    content = _io().read_colmap(found)
    cameras = {fields[0]: ColmapCamera(*fields) for fields in content["cameras"]}
    images = [
        ColmapImage(image_id, os.fsdecode(name), camera_id, qvec, tvec)
        for image_id, name, camera_id, qvec, tvec in content["images"]
    ]
    return ColmapModel(cameras, images, Points(**content["points"]), content["point_errors"], os.fsdecode(found))


def read_colmap_cameras(path: PathLike) -> Dict[int, ColmapCamera]:
    """Reads one cameras.bin or cameras.txt, by id; for data that has no images file. Raises as `read_colmap`."""
    return {fields[0]: ColmapCamera(*fields) for fields in _io().read_colmap_cameras(os.fsencode(path))}


def write_colmap(folder: PathLike, model: ColmapModel, text: bool = False) -> None:
    """Writes cameras, images and points3D (.bin, or .txt if `text`) into folder, which is made if it is missing.

    Points get black if there are no colours, and COLMAP's -1 if there are no errors. Normals are not stored.
    Raises OSError; ValueError naming what cannot be written.
    """
    cameras = [
        (camera.id, camera.model, camera.width, camera.height, np.asarray(camera.params, np.float64).tolist())
        for camera in model.cameras.values()
    ]
    images = [
        (
            image.id,
            os.fsencode(image.name),
            image.camera_id,
            _array("write_colmap", "qvec", image.qvec, np.float64, (4,)).tolist(),
            _array("write_colmap", "tvec", image.tvec, np.float64, (3,)).tolist(),
        )
        for image in model.images
    ]
    positions, colors = _cloud("write_colmap", model.points)
    errors = _optional_array("write_colmap", "point_errors", model.point_errors, np.float64, (len(positions),))
    _io().write_colmap(os.fsencode(folder), cameras, images, positions, colors, errors, text)


def _sh_degree(function: str, shs: Any) -> int:
    shape = np.shape(shs)
    for degree in range(4):
        if len(shape) == 3 and shape[1] == (degree + 1) ** 2 - 1:
            return degree
    raise ValueError(f"{function}: shs has shape {list(shape)}; it must be [N, K-1, 3] with K-1 one of 0, 3, 8, 15")


def _array(function: str, name: str, value: Any, dtype: Any, shape: Sequence[int]) -> np.ndarray:
    array = np.ascontiguousarray(value, dtype=dtype)
    if array.shape != tuple(shape):
        raise ValueError(f"{function}: {name} has shape {list(array.shape)}; it must be {list(shape)}")
    return array


def _optional_array(function: str, name: str, value: Any, dtype: Any, shape: Sequence[int]) -> Optional[np.ndarray]:
    return None if value is None else _array(function, name, value, dtype, shape)


def _cloud(function: str, points: Points) -> Tuple[np.ndarray, Optional[np.ndarray]]:
    count = np.shape(points.positions)[0] if np.ndim(points.positions) else 0
    positions = _array(function, "positions", points.positions, np.float64, (count, 3))
    colors = points.colors
    if colors is not None and np.asarray(colors).dtype != np.uint8:
        raise ValueError(f"{function}: colors has type {np.asarray(colors).dtype}; it must be uint8, 0 to 255")
    return positions, _optional_array(function, "colors", colors, np.uint8, (count, 3))
