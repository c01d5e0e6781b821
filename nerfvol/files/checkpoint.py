"""Checkpoints: a nested dict of tensors, arrays and plain values in one safetensors file. Never pickle.

The arrays lie in the file under the names "0", "1", ...; the JSON document in its header repeats the nesting and says
where each array goes. Loading builds only dicts, lists, numbers, strings, tensors and arrays, so it can run no code.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np

from nerfvol.errors import shown
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.native import need_torch

_FORMAT = "nerfvol checkpoint"
_VERSION = 1
_MAX_NESTING = 32


def save_checkpoint(path: str | os.PathLike[str], state: dict[Any, Any]) -> int:
    """Write ``state`` to ``path`` atomically; returns the file's size in bytes.

    ``state`` nests dicts (keys str or int), lists and tuples (tuples come back as lists) of torch tensors (any device;
    they come back on the CPU), numpy arrays and scalars, numbers, strings, booleans and None.

    Raises:
        InputError: the disk is full or the path not writable; the previous checkpoint is untouched.
        TypeError: a value of another type (the message gives its place).
    """
    arrays: dict[str, np.ndarray] = {}
    tree = _pack(state, arrays, "state")
    return write_arrays(path, arrays, {"format": _FORMAT, "version": _VERSION, "tree": tree})


def load_checkpoint(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """Read what :func:`save_checkpoint` wrote.

    Raises:
        InputError: missing, truncated or foreign file, or one that another version of nerfvol wrote.
    """
    with ArrayFile(path, "checkpoint") as file:
        found = file.document.get("format"), file.document.get("version")
        if found != (_FORMAT, _VERSION):
            raise file.fault(
                f"expected {_FORMAT} version {_VERSION}, it says {shown(found[0])} version {shown(found[1])}"
            )
        state = _unpack(file.document.get("tree"), file, 0)
        if not isinstance(state, dict):
            raise file.fault("its outermost value is not a dict")
        return state


def _pack(value: Any, arrays: dict[str, np.ndarray], place: str) -> Any:
    """``value`` as JSON; what JSON has no word for becomes ``[tag, ...]``, so every list in the tree is tagged."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, np.integer)) and not isinstance(value, np.bool_):
        return int(value)
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return number if math.isfinite(number) else ["float", repr(number)]
    if isinstance(value, dict):
        return ["dict", [[_key(key, place), _pack(item, arrays, f"{place}[{key!r}]")] for key, item in value.items()]]
    if isinstance(value, (list, tuple)):
        return ["list", [_pack(item, arrays, f"{place}[{index}]") for index, item in enumerate(value)]]
    name = str(len(arrays))
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return ["array", name]
    # Asked by module name: a checkpoint of plain arrays must not cost the import of torch.
    if type(value).__module__.split(".")[0] == "torch" and hasattr(value, "detach"):
        arrays[name] = value.detach().cpu().contiguous().numpy()
        return ["tensor", name]
    raise TypeError(f"{place} is a {type(value).__name__}, which a checkpoint cannot hold")


def _key(key: Any, place: str) -> str | int:
    if isinstance(key, bool) or not isinstance(key, (str, int)):
        raise TypeError(f"{place} has the key {key!r}: a checkpoint's keys are strings or integers")
    return key


def _unpack(tree: Any, file: ArrayFile, depth: int) -> Any:
    if depth > _MAX_NESTING:
        raise file.fault(f"it is nested more than {_MAX_NESTING} deep")
    if not isinstance(tree, list):
        if isinstance(tree, dict):
            raise file.fault("its tree of values is damaged")
        return tree
    match tree:
        case ["dict", list(items)]:
            unpacked = {}
            for item in items:
                match item:
                    case [str() | int() as key, value]:
                        unpacked[key] = _unpack(value, file, depth + 1)
                    case _:
                        raise file.fault("its tree of values is damaged")
            return unpacked
        case ["list", list(items)]:
            return [_unpack(item, file, depth + 1) for item in items]
        case ["float", "nan" | "inf" | "-inf" as text]:
            return float(text)
        case ["array", str(name)]:
            return file.read(name)
        case ["tensor", str(name)]:
            need_torch(f"{file.path}, whose field was trained in torch,")
            import torch

            return torch.from_numpy(file.read(name))
        case _:
            raise file.fault("its tree of values is damaged")
