"""Masks by the conventions of other programs: which file says which pixels of an image count (docs/data.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nerfvol.datasets.listing import Frame, ImageFinder, MaskFile, named


class MaskFinder:
    """Masks by the conventions of other programs: what a file names, ``dynamic_mask_NAME`` and folders of masks."""

    def __init__(self, folder: Path, images: Path | None = None) -> None:
        """``folder``: of the data set; ``images``: of the photographs, where masks folders may lie too."""
        self._finder = ImageFinder(folder)
        self._beside: dict[Path, ImageFinder] = {}
        homes = [folder] if images is None or images == folder else [folder, images, images.parent]
        places = dict.fromkeys(home / name for home in homes for name in ("masks", "mask"))
        self._folders = [place for place in places if place.is_dir()]
        self._in_use: set[Path] = set()
        self.missing: list[str] = []

    def of(self, listed: str, path: Path | None, stated: str | None = None) -> tuple[MaskFile, ...]:
        """The masks of the image ``listed`` at ``path``; ``stated``: what its file names as such."""
        if path is None:
            return ()
        found = []
        if stated is not None:
            mask = self._finder.find(stated)
            if mask is None:
                self.missing.append(stated)
            else:
                found.append(MaskFile(mask))
        beside = self._beside.setdefault(path.parent, ImageFinder(path.parent))
        named_so = beside.mentions("mask")  # names of all that is looked for there
        for name in (f"dynamic_mask_{path.name}", f"dynamic_mask_{path.stem}") if named_so else ():
            if (mask := beside.find(name)) is not None:
                found.append(MaskFile(mask, black_is_out=False))
                break
        for name in _beside(path) if named_so and not found else ():
            if (mask := beside.find(name)) is not None and mask != path:
                return (MaskFile(mask),)
        if not found:
            found += self._in_folders(listed, path)
        return tuple(found)

    def _in_folders(self, listed: str, path: Path) -> list[MaskFile]:
        """COLMAP's: the image's name and .png, below a folder of masks; or the image's stem, alone or as Metashape ends it."""
        for folder in self._folders:
            finder = self._beside.setdefault(folder, ImageFinder(folder))
            inside = listed.replace("\\", "/")
            for name in (f"{inside}.png", f"{path.name}.png", inside, path.stem, *_beside(path)):
                if path.parent != folder and (mask := finder.find(name)) is not None and mask != path:
                    self._in_use.add(folder)
                    return [MaskFile(mask)]
        return []

    def messages(self, frames: Sequence[Frame]) -> list[str]:
        """Sentences on the masks of ``frames``."""
        with_mask = [frame.listed for frame in frames if frame.masks]
        said = []
        if with_mask:
            said.append(
                f"{len(with_mask)} of {len(frames)} images have masks: what those leave out takes no part in training "
                "and scores"
            )
        if idle := [folder for folder in self._folders if folder not in self._in_use and not with_mask and frames]:
            said.append(
                f"{idle[0]} is not used: none of its files is named like an image (NAME.png, NAME.jpg.png or NAME_mask.png)"
            )
        if self.missing:
            said.append(
                f"{len(self.missing)} masks that are named are not on disk, and their images count whole: {named(self.missing)}"
            )
        return said


def _beside(path: Path) -> tuple[str, str, str]:
    """What RealityCapture and Metashape call the mask of the image ``path``, without the suffix."""
    return f"{path.name}.mask", f"{path.stem}.mask", f"{path.stem}_mask"
