"""COLMAP models and projects: poses from the sparse model, pictures from the images folder beside it.

The scale of such a world is arbitrary unless the user scaled it. A dense cloud (fused.ply) is used where
there is one, else the sparse points.
"""

from __future__ import annotations

from pathlib import Path

from capture.colmap_model import is_colmap_model, read_colmap_model
from capture.errors import SourceError
from capture.images import natural_order
from capture.importers.image_set import write_image_set
from capture.importers.options import ImportOptions, Progress
from capture.importers.source_frame import SourceFrame
from capture.ply import PointCloud
from capture.session import Session

_CLOUDS = ("fused.ply", "dense/fused.ply", "dense/0/fused.ply")


def find_colmap_model(folder: Path) -> Path | None:
    """The model that a folder is or holds in sparse/; of several parts the one with the most images."""
    if is_colmap_model(folder):
        return folder
    parts = [folder / "sparse", *sorted((folder / "sparse").glob("*"))]
    models = [part for part in parts if part.is_dir() and is_colmap_model(part)]
    return max(models, key=_size_of_images, default=None)


def import_colmap(model: Path, out: Path, options: ImportOptions, progress: Progress) -> Session:
    """Makes a session of a model folder as `find_colmap_model` gives it.

    Frames are numbered in the natural order of their names. Without a flash list their flash is unknown.

    Raises:
        SourceError: the model is malformed, or a picture is missing or does not fit.
    """
    reconstruction = read_colmap_model(model)
    model = model.resolve()
    roots = [model, *list(model.parents)[:2]]
    images = next((root / "images" for root in roots if (root / "images").is_dir()), None)
    if images is None:
        raise SourceError(
            f"There is no folder 'images' beside {model}; put the pictures there, or a link to them."
        )
    names = sorted(reconstruction.cameras, key=natural_order)
    masks = images.parent / "masks"
    frames = []
    for index, name in enumerate(names):
        camera = reconstruction.cameras[name]
        mask = masks / f"{name}.png" if masks.is_dir() else None
        size = (camera.width, camera.height)
        frames.append(SourceFrame(index, name, images / name, size, camera, mask=mask))
    return write_image_set(
        out,
        frames,
        source={"kind": "colmap", "path": str(model), "units": "arbitrary"},
        transfer="srgb",
        cloud=_cloud(roots, reconstruction.points),
        options=options,
        progress=progress,
    )


def _size_of_images(model: Path) -> int:
    return max(file.stat().st_size for file in model.glob("images.*"))


def _cloud(roots: list[Path], sparse: PointCloud | None) -> Path | PointCloud | None:
    return next((root / name for root in roots for name in _CLOUDS if (root / name).is_file()), sparse)
