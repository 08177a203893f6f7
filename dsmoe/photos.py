"""Photographs to a scene: COLMAP, by pycolmap, finds where each was taken, and may remove the lens distortion."""
from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
import sqlite3
import threading
import time
import urllib.parse
from dataclasses import dataclass
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

import numpy as np

from diff_smoe_rasterization import io

from .errors import SceneError, TrainerError, printable
from .options.choices import CAMERA_MODEL, LENSES, MATCHING, MOST_EXHAUSTIVE
from .options.early import FROM_VIDEO, VIDEO_ENDINGS, check_photos
from .scenes.cameras import Camera
from .scenes.images import UNREADABLE, check_depth, image_size, open_image
from .scenes.lens import AROUND, MODELS, colmap_intrinsics
from .scenes.undistortion import MOST_CUT, cut_off
from .system.files import is_file, write_json_atomically
from .system.output_folder import Record, make_folder, only_one, own_record, remove_files, write_record
from .system.process import pip_install
from .system.progress import progress_bar

SCENE = "dsmoe scene"  # in its folder's record
WORK = "colmap"  # folder in the scene's: the database, which a second run goes on with
DATABASE = "database.db"
FEATURES = "photographs.json"  # of which photographs the database has features
WRITTEN = ("images", "sparse/0", *(f"{WORK}/{name}" for name in ("models", "best", "made")))
ENDINGS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
UNKNOWN_ENDINGS = (".heic", ".heif", ".dng", ".raw", ".cr2", ".nef", ".arw")
MIN_PHOTOS = 3
POLL_SECONDS = 0.5
FISHEYE_FOV = 150.0  # degrees along the longer side, of a fisheye whose photographs record nothing
MOST_FOV, MOST_FISHEYE_FOV = 170.0, 340.0
FOCAL_LENGTH, EXIF = 37386, 0x8769  # tags
ADVICE = ("Neighbouring photographs should show two thirds of the same things, sharply, with texture, from places that "
          "differ: walk around, do not only turn the camera. ")


@dataclass(frozen=True)
class Made:
    """What became of the photographs."""

    folder: str
    photos: int
    registered: int
    points: int
    error: float  # mean reprojection error, pixels
    left_out: List[str]
    size: Tuple[int, int]  # width and height of its first image
    options: Tuple[str, ...]  # of `dsmoe train`, without which it would do something else with the lens

    def __str__(self) -> str:
        more = ", ..." if self.left_out[3:] else ""
        left = f" (left out: {', '.join(self.left_out[:3])}{more})" if self.left_out else ""
        return (f"{self.registered} of {self.photos} photographs are placed{left}; {self.points:,} points, mean "
                f"reprojection error {self.error:.2f} pixels")


def make_scene(photos: str, output: str, matching: str = MATCHING[0], camera_model: str = CAMERA_MODEL,
               progress: bool = True, say: Callable[[str], None] = lambda text: None, lenses: str = LENSES[0],
               fov: Optional[float] = None) -> Made:
    """Writes a COLMAP scene of the photographs in a folder: the images, and where each was taken.

    matching: "exhaustive" compares all pairs, "sequential" neighbours by name, "auto" all pairs of up to
    MOST_EXHAUSTIVE. say: is called with a line before each step. lenses: "undistort" writes images of a pinhole camera,
    "native" the photographs with the lens that COLMAP found, "auto" these where undistortion would cut off much. fov:
    about how many degrees a photograph shows along its longer side; None: as it records, else COLMAP's guess. Raises
    SceneError, also if the photographs do not connect, and TrainerError without pycolmap.
    """
    names = photo_names(photos, output, say)
    for path in (photos, output, *names):
        if any("\ud800" <= letter <= "\udfff" for letter in path):
            raise SceneError(f"{path}: COLMAP takes only names that are UTF-8; rename it")
    try:
        import pycolmap
    except ImportError as error:
        raise TrainerError(f"dsmoe scene needs COLMAP's Python package: {pip_install('pycolmap')}") from error
    own_record(output, SCENE, folders=WRITTEN)  # refused before anything is made
    make_folder(output)
    with only_one(output):
        earlier = own_record(output, SCENE, folders=WRITTEN)
        subject = os.path.abspath(photos)
        if earlier.subject not in ("", subject):
            raise SceneError(f"{output} holds the scene of other photographs, {earlier.subject}; choose another folder "
                             "with -o, or remove it")
        work = os.path.join(output, WORK)
        os.makedirs(work, exist_ok=True)
        write_record(output, SCENE, Record(subject, earlier.files), earlier.files)
        pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # from now on it prints only errors
        best = _placed(pycolmap, photos, names, work, matching, camera_model, fov, progress, say)
        placed = sorted(best.images[number].name for number in best.reg_image_ids())
        found, made = os.path.join(work, "best"), os.path.join(work, "made")
        cut = _cut_off(found)
        keeps = lenses == "native" or lenses == "auto" and cut > MOST_CUT
        shutil.rmtree(made, ignore_errors=True)
        if keeps:
            say(f"keeping the lens; without it {100 * cut:.0f} % of the pixels would be cut off")
            _keep(photos, placed, found, made)
        else:
            say("undistorting")
            _while_counting(pycolmap, lambda token: pycolmap.undistort_images(
                made, found, photos, cancellation_token=token),
                lambda: _count_files(os.path.join(made, "images")), len(placed), "undistortion", progress)
        files = _taken_over(made, output, subject, earlier.files)
        write_record(output, SCENE, Record(subject, files), files)
    return Made(output, len(names), len(placed), best.num_points3D(), best.compute_mean_reprojection_error(),
                sorted({*names} - {*placed}), image_size(os.path.join(output, files[0])),
                ("--lenses", "native") if keeps and cut <= MOST_CUT else ())


def _cut_off(folder: str) -> float:
    """The largest part of a camera's pixels that undistortion cuts off; 0 for models that only COLMAP undistorts."""
    cut = 0.0
    for camera in io.read_colmap(folder).cameras.values():
        fx, fy, cx, cy, lens = colmap_intrinsics(camera) if camera.model in MODELS else (1.0, 1.0, 0.0, 0.0, None)
        if lens:
            pinhole = Camera("", np.eye(3), np.zeros(3), fx, fy, cx, cy, int(camera.width), int(camera.height))
            cut = max(cut, cut_off(pinhole, lens))
    return cut


def _keep(photos: str, names: Sequence[str], found: str, made: str) -> None:
    """Copies the photographs and COLMAP's model to where its undistortion has them in `made`. Raises SceneError."""
    shutil.copytree(found, os.path.join(made, "sparse"))
    for name in names:
        source, target = os.path.join(photos, name), os.path.join(made, "images", name)
        try:
            with open_image(source) as file:
                check_depth(file)
        except UNREADABLE as error:
            raise SceneError(f"{source}: cannot be kept as it is ({error}); or take --lenses undistort") from error
        os.makedirs(os.path.dirname(target), exist_ok=True)
        shutil.copyfile(source, target)


def _refuse(error: OSError) -> None:
    raise SceneError(f"{error.filename}: photographs there cannot be read ({error.strerror}); take the right to, or "
                     "move the folder away")


def photo_names(folder: str, output: str, say: Callable[[str], None] = lambda text: None) -> List[str]:
    """The photographs below a folder, by their paths in it; hidden files and the folder `output` are left out.

    say: is called if a video is among them. Raises SceneError if they are too few, or one is a pipe or a device, which
    reading would wait for.
    """
    check_photos(folder)
    made = os.path.join(os.path.realpath(output), "")
    if os.path.join(os.path.realpath(folder), "").startswith(made):
        raise SceneError(f"{folder} lies in {output}, the folder to write; name another one with -o")
    names = sorted(os.path.relpath(os.path.join(place, name), folder)
                   for place, _, files in os.walk(folder, onerror=_refuse)
                   if not os.path.join(os.path.realpath(place), "").startswith(made)
                   for name in files if not name.startswith("."))
    found = [name for name in names if name.lower().endswith(ENDINGS)]
    strange = next((name for name in found if not is_file(os.path.join(folder, name))), None)
    if strange:
        raise SceneError(f"{os.path.join(folder, strange)}: cannot be read as a file (a pipe, a device, or a link "
                         "to one or to nothing); remove it")
    video = next((name for name in names if name.lower().endswith(VIDEO_ENDINGS)), None)
    hint = f"{video} is a video; {FROM_VIDEO}" if video else ""
    if hint and len(found) >= MIN_PHOTOS:
        say(printable(f"note: {hint}; it is left out"))
    if len(found) < MIN_PHOTOS:
        other = next((name for name in names if name.lower().endswith(UNKNOWN_ENDINGS)), None)
        hint = f"{other} is of a kind that COLMAP does not read: convert it to JPEG" if other else hint
        raise SceneError(f"{folder}: {len(found)} photographs ({', '.join(ENDINGS)}) are in it; at least {MIN_PHOTOS} "
                         f"are needed{'; ' * bool(hint)}{hint}")
    return found


def _placed(pycolmap: Any, photos: str, names: List[str], work: str, matching: str, camera_model: str,
            fov: Optional[float], progress: bool, say: Callable[[str], None]) -> Any:
    """The largest model that COLMAP makes of the photographs, which it also writes to WORK/best. Raises SceneError."""
    database, count = os.path.join(work, DATABASE), len(names)
    cameras = _by_camera(photos, names, fov, say)
    guesses = [_camera_guess(pycolmap, os.path.join(photos, first), camera_model, fov) for first, *_ in cameras]
    if _forget_others(photos, names, work, f"{camera_model} {fov}"):
        say("photographs or camera model have changed since the last time: all features are found anew")
    say(f"finding features in {count} photographs of {'several cameras' if cameras[1:] else 'one camera'}, on the "
        f"{'GPU' if pycolmap.has_cuda else 'CPU'}")
    mode = pycolmap.CameraMode.SINGLE
    if cameras[1:] and not any(guesses):  # COLMAP's own guesses need no pass for each
        cameras, guesses, mode = [names], [""], pycolmap.CameraMode.AUTO
    for group, guess in zip(cameras, guesses):
        reader = _reader(pycolmap, camera_model, guess)
        _while_counting(pycolmap, lambda token, group=group, reader=reader: pycolmap.extract_features(
            database, photos, group, mode, reader, cancellation_token=token),
            lambda: _count_rows(database, "descriptors"), count, "features", progress)
    if matching == "auto":
        matching = "exhaustive" if count <= MOST_EXHAUSTIVE else "sequential"
    pairs = count * (count - 1) // 2
    if matching == "exhaustive":
        say(f"comparing all {pairs:,} pairs")
        _while_counting(pycolmap, lambda token: pycolmap.match_exhaustive(database, cancellation_token=token),
                        lambda: _count_rows(database, "two_view_geometries"), pairs, "pairs", progress)
    else:
        say("comparing neighbours, as sorted by name; --matching exhaustive compares all pairs, which takes longer")
        _while_counting(pycolmap, lambda token: pycolmap.match_sequential(database, cancellation_token=token),
                        lambda: _count_rows(database, "two_view_geometries"), None, "pairs", progress)
    say("placing them")
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = max(MIN_PHOTOS, min(10, count // 2))
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    models = os.path.join(work, "models")
    shutil.rmtree(models, ignore_errors=True)
    os.makedirs(models)
    with progress_bar(total=count, desc="photographs", unit="photograph", leave=False, disable=not progress) as bar:
        made = _in_thread(pycolmap, lambda token: pycolmap.incremental_mapping(
            database, photos, models, options, initial_image_pair_callback=lambda: bar.update(2),
            next_image_callback=lambda: bar.update(1), cancellation_token=token))
    best = max(made.values(), key=lambda model: model.num_reg_images(), default=None)
    registered = best.num_reg_images() if best else 0
    if registered < max(MIN_PHOTOS, count / 2):
        more = "" if matching == "exhaustive" else "Only neighbours by name were compared: try --matching exhaustive. "
        raise SceneError(f"{photos}: only {registered} of {count} photographs connect to each other. {more}{ADVICE}"
                         "Remove blurred ones, add some between those that do not connect, and type the same command "
                         "again")
    shutil.rmtree(os.path.join(work, "best"), ignore_errors=True)
    os.makedirs(os.path.join(work, "best"))
    best.write(os.path.join(work, "best"))
    return best


def _reader(pycolmap: Any, camera_model: str, guess: str) -> Any:
    options = pycolmap.ImageReaderOptions()
    options.camera_model, options.camera_params = camera_model, guess
    return options


def _camera_guess(pycolmap: Any, photo: str, camera_model: str, fov: Optional[float]) -> str:
    """As `_first_guess`, unless COLMAP knows the focal length in pixels, which millimetres alone do not tell it."""
    guess = _first_guess(photo, camera_model, fov)
    if not guess or fov is not None:
        return guess
    camera = _in_thread(pycolmap, lambda token: pycolmap.infer_camera_from_image(
        photo, _reader(pycolmap, camera_model, "")))
    return "" if camera.has_prior_focal_length else guess


def _first_guess(photo: str, camera_model: str, fov: Optional[float]) -> str:
    """The parameters from which COLMAP starts for cameras of the photograph's size; empty: as it guesses them itself.

    Through a fisheye it places nothing from its own guess of 48 degrees, as it compares photographs by a pinhole.
    Raises SceneError.
    """
    is_fisheye = "FISHEYE" in camera_model
    if fov is None and not is_fisheye:
        return ""
    if camera_model not in MODELS:
        raise SceneError(f"the camera model is {camera_model}, of which no first guess is known here; it must be one "
                         f"of {', '.join(MODELS)}{'' if is_fisheye else ', or without a field of view (fov)'}")
    angle, most = FISHEYE_FOV if fov is None else fov, MOST_FISHEYE_FOV if is_fisheye else MOST_FOV
    if camera_model == AROUND or not 1 <= angle <= most:
        allowed = f"between 1 and {most:g} degrees" if camera_model != AROUND else "left out: it is 360 degrees"
        raise SceneError(f"--fov is {angle:g}; for --camera-model {camera_model} it must be {allowed}")
    width, height = image_size(photo)
    half = math.radians(angle) / 2
    focal = max(width, height) / 2 / (half if is_fisheye else math.tan(half))
    focals, _, coefficients = MODELS[camera_model]
    return ",".join(f"{value:g}" for value in (*[focal] * focals, width / 2, height / 2, *[0] * len(coefficients)))


def _forget_others(photos: str, names: Sequence[str], work: str, camera_model: str) -> bool:
    """Removes the database if it is of other photographs, or of another camera model; returns whether it did.

    COLMAP knows photographs by their names, and takes those that it knows for unchanged. Further ones are welcome.
    """
    path = os.path.join(work, FEATURES)
    now = {"camera model": camera_model, "photographs": {name: _checksum(os.path.join(photos, name)) for name in names}}
    before: Any = {}
    if is_file(path):
        with contextlib.suppress(ValueError, RecursionError), open(path, encoding="utf-8") as file:
            before = json.load(file)
    known = isinstance(before, dict) and before.get("camera model") == camera_model and isinstance(
        before.get("photographs"), dict) and before["photographs"].items() <= now["photographs"].items()
    there = is_file(os.path.join(work, DATABASE))
    if not known:
        for ending in ("", "-journal", "-wal", "-shm"):
            with contextlib.suppress(FileNotFoundError):
                os.remove(os.path.join(work, DATABASE + ending))
    write_json_atomically(path, now)
    return there and not known


def _checksum(path: str) -> str:
    hashed = hashlib.sha256()
    with open(path, "rb") as file:
        for part in iter(lambda: file.read(1 << 20), b""):
            hashed.update(part)
    return hashed.hexdigest()


def _by_camera(photos: str, names: Sequence[str], fov: Optional[float], say: Callable[[str], None]) -> List[List[str]]:
    """The names by camera: those of one size, and of one focal length if they record it.

    say: is called if they record several while `fov`, from which all cameras start then, is given.
    """
    cameras: Dict[Tuple[Tuple[int, int], Optional[float]], List[str]] = {}
    for name in names:
        path = os.path.join(photos, name)
        cameras.setdefault((image_size(path), _recorded_focal_length(path)), []).append(name)
    focals = [f"{focal:g} mm" if focal else "none" for focal in {focal: 0 for _, focal in cameras}]
    if fov is not None and len(focals) > 1:
        some = ", ".join(focals[:3]) + ", ..." * bool(focals[3:])
        say(f"note: the photographs record several focal lengths ({some}), and each camera starts from --fov {fov:g}; "
            "without --fov it starts from what they record")
    return [*cameras.values()]


def _recorded_focal_length(path: str) -> Optional[float]:
    try:
        with open_image(path) as file:
            focal = float(file.getexif().get_ifd(EXIF)[FOCAL_LENGTH])
    except (*UNREADABLE, KeyError, TypeError, ZeroDivisionError):
        return None
    return focal if 0 < focal < math.inf else None


def _taken_over(made: str, output: str, subject: str, earlier: Sequence[str]) -> List[str]:
    """Moves images and model of COLMAP's undistortion to where a scene has them; returns their paths in `output`."""
    moves: List[Tuple[str, str]] = []
    for folder, place in (("images", "images"), ("sparse", os.path.join("sparse", "0"))):
        for where, _, files in os.walk(os.path.join(made, folder)):
            for name in files:
                source = os.path.join(where, name)
                moves.append((source, os.path.join(place, os.path.relpath(source, os.path.join(made, folder)))))
    files = sorted(target for _, target in moves)
    write_record(output, SCENE, Record(subject, files), earlier)
    remove_files(output, files)
    for source, target in moves:
        os.makedirs(os.path.dirname(os.path.join(output, target)), exist_ok=True)
        shutil.move(source, os.path.join(output, target))
    shutil.rmtree(made)
    return files


def _while_counting(pycolmap: Any, work: Callable[[Any], Any], done: Callable[[], int], total: Optional[int], what: str,
                    progress: bool) -> None:
    """Does the work, as `_in_thread`, and shows meanwhile how much of it is done."""
    with progress_bar(total=total, desc=what, leave=False, disable=not progress) as bar:
        def show() -> None:
            bar.update(max(0, done() - bar.n))

        _in_thread(pycolmap, work, show)


def _in_thread(pycolmap: Any, work: Callable[[Any], Any], show: Callable[[], None] = lambda: None) -> Any:
    """The result of the work, which another thread does, so that this one can show how far it is.

    work: is given a token that cancels it, which Ctrl-C does. COLMAP's errors become SceneErrors.
    """
    outcome: List[Any] = []
    token = pycolmap.CancellationToken()

    def run() -> None:
        try:
            outcome.append(work(token))
        except Exception as error:
            outcome.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    shown = 0.0
    try:
        while thread.is_alive():
            thread.join(0.05)
            if time.monotonic() - shown > POLL_SECONDS:
                shown = time.monotonic()
                show()
    except KeyboardInterrupt:
        token.cancel()
        thread.join()  # it must not outlive Python
        raise
    if isinstance(outcome[0], Exception):
        raise SceneError(f"COLMAP: {outcome[0]}") from outcome[0]
    return outcome[0]


def _count_rows(database: str, table: str) -> int:
    """How many rows are in the file, without what is in its journal yet; 0 if it cannot be read at the moment.

    immutable: no lock is taken, on which COLMAP would end the process.
    """
    try:
        address = f"file:{urllib.parse.quote(os.path.abspath(database))}?immutable=1"
        with contextlib.closing(sqlite3.connect(address, uri=True)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:
        return 0


def _count_files(folder: str) -> int:
    return sum(len(files) for _, _, files in os.walk(folder))
