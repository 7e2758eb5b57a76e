"""Weights files: safetensors whose header holds everything needed to build and to judge the network.

Knows no network: the caller builds one from the header's configuration and compares shapes with `verify`. Nothing is
ever unpickled. A file's sha256 is checked whenever a `SHA256SUMS` file beside it lists the file.

All functions raise `WeightsError`, and nothing else, for a file that cannot be used or written.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from tesnet.errors import WeightsError
from tesnet.whole_file import write_whole

SUMS = "SHA256SUMS"
"""Name of the file that lists checksums of the files beside it, as `sha256sum` writes it."""

# One key: safetensors orders several at random, and the same weights shall give the same bytes.
_KEY = "tesnet"
_FORMAT = 1
_SUFFIX = ".safetensors"
_PICKLES = (b"PK\x03\x04", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")  # torch.save, new and old


@dataclass(frozen=True, slots=True)
class Header:
    """What travels with the tensors.

    Args:
        network: name of the network in the registry.
        version: of these weights.
        configuration: JSON values from which the network, the cloud preparation and the candidates are built.
        calibration: (a, b) of the served score sigmoid(a * logit + b); finite.
        training: JSON values of what a card states: data, seed, commit, metrics.
    """

    network: str
    version: str
    configuration: Mapping[str, Any]
    calibration: tuple[float, float] = (1.0, 0.0)
    training: Mapping[str, Any] = field(default_factory=dict)


def load(path: Path) -> tuple[dict[str, Tensor], Header]:
    """The tensors on the CPU, all finite, and the header of a weights file whose checksum, if listed, is right."""
    data = _read(path)
    _check_sum(path, data)
    state_dict = _tensors(path, data)
    _check_finite(path, state_dict)
    return state_dict, _header(path, data)


def save(path: Path, state_dict: Mapping[str, Tensor], header: Header) -> None:
    """Write a weights file in one step: a reader sees the old file or the new one. Equal content gives equal bytes.

    Checksums are the caller's: a `SHA256SUMS` beside the file is left alone.
    """
    _check_finite(path, state_dict)
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in state_dict.items()}
    data = safetensors.torch.save(tensors, {_KEY: _to_json(path, header)})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, data)
    except OSError as error:
        raise WeightsError(path, f"cannot be written: {error.strerror}; choose a writable place") from error


def verify(path: Path, state_dict: Mapping[str, Tensor], expected_shapes: Mapping[str, Sequence[int]]) -> None:
    """Raise unless the tensors of `path` have exactly the names and shapes of the network built from its header."""
    remedy = "the file belongs to another network or version; load it with the version of this package that wrote it"
    if missing := sorted(expected_shapes.keys() - state_dict.keys()):
        raise WeightsError(path, f"lacks {_listed(missing)} of the network's {len(expected_shapes)} tensors; {remedy}")
    if extra := sorted(state_dict.keys() - expected_shapes.keys()):
        raise WeightsError(path, f"holds {_listed(extra)}, which the network does not have; {remedy}")
    for name, expected in expected_shapes.items():
        found = tuple(state_dict[name].shape)
        if found != tuple(expected):
            raise WeightsError(path, f"tensor {name} has shape {found}, the network wants {tuple(expected)}; {remedy}")


def sha256(path: Path) -> str:
    """The file's checksum, 64 hexadecimal digits."""
    return hashlib.sha256(_read(path)).hexdigest()


def default_weights(name: str = "tesnet") -> Path:
    """Path of the weights that come with the project; `name` is one of theirs."""
    try:
        folder = resources.files("weights")
        files = {entry.name: entry for entry in folder.iterdir() if entry.name.endswith(_SUFFIX)}
    except (ModuleNotFoundError, OSError) as error:
        why = "the package of shipped weights is not installed; install the project again or give a path"
        raise WeightsError(f"weights/{name}{_SUFFIX}", why) from error
    found = files.get(f"{name}{_SUFFIX}")
    if not isinstance(found, Path):
        names = ", ".join(sorted(file.removesuffix(_SUFFIX) for file in files)) or "none"
        why = f"no network {name!r} among the shipped weights; there are: {names}. Choose one of them or give a path"
        raise WeightsError(f"{folder}/{name}{_SUFFIX}", why)
    return found


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise WeightsError(path, "no such file; check the path, or download the weights there") from error
    except OSError as error:
        raise WeightsError(path, f"cannot be read: {error.strerror}; give the path of a readable file") from error


def _check_sum(path: Path, data: bytes) -> None:
    """Compare with the file's line in the checksums beside it, if there is one: `<sha256> [*]<name>`."""
    try:
        lines = path.with_name(SUMS).read_text("utf-8").splitlines()
    except FileNotFoundError:
        return
    except (OSError, UnicodeDecodeError) as error:
        raise WeightsError(path, f"the {SUMS} beside it cannot be read; restore or remove it") from error
    listed = {name.lstrip(" *"): digest for digest, _, name in (line.strip().partition(" ") for line in lines)}
    wanted, found = listed.get(path.name), hashlib.sha256(data).hexdigest()
    if wanted is not None and wanted.lower() != found:
        why = f"sha256 is {found}, the {SUMS} beside it wants {wanted}; the file is damaged or exchanged: get it again"
        raise WeightsError(path, why)


def _tensors(path: Path, data: bytes) -> dict[str, Tensor]:
    try:
        return safetensors.torch.load(data)
    except (SafetensorError, KeyError, ValueError, RuntimeError) as error:
        if _is_cut_short(data):
            raise WeightsError(path, f"is cut short after {len(data)} bytes; get the file again") from error
        if data.startswith(_PICKLES):
            why = (
                "is a Python pickle (as torch.save writes .pt files), which may run any code when opened; only "
                f"{_SUFFIX} files are loaded: convert it on the machine where it was trained"
            )
            raise WeightsError(path, why) from error
        raise WeightsError(path, f"is not a safetensors file ({error}); give a {_SUFFIX} file") from error


def _is_cut_short(data: bytes) -> bool:
    """Whether data begins like a safetensors file, 8 bytes of length and a JSON object, and ends too early."""
    length = int.from_bytes(data[:8], "little")
    if data[8:9] != b"{" or 8 + length > len(data):
        return data[8:9] == b"{"
    try:
        entries = json.loads(data[8 : 8 + length])
        ends = [entry["data_offsets"][1] for name, entry in entries.items() if name != "__metadata__"]
        return 8 + length + max(ends, default=0) > len(data)
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return False


def _check_finite(path: Path, state_dict: Mapping[str, Tensor]) -> None:
    for name, tensor in state_dict.items():
        bad = int((~torch.isfinite(tensor)).sum()) if tensor.is_floating_point() else 0
        if bad:
            why = f"tensor {name} holds {bad} of {tensor.numel()} values that are not finite; the training went wrong"
            raise WeightsError(path, f"{why}: use an earlier checkpoint")


def _to_json(path: Path, header: Header) -> str:
    fields = {
        "format": _FORMAT,
        "network": header.network,
        "version": header.version,
        "configuration": dict(header.configuration),
        "calibration": list(header.calibration),
        "training": dict(header.training),
    }
    try:
        return json.dumps(fields, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise WeightsError(path, f"the header is not JSON ({error}); use numbers, text, lists and mappings") from error


def _header(path: Path, data: bytes) -> Header:
    """The header of data that safetensors has accepted."""
    length = int.from_bytes(data[:8], "little")
    text = (json.loads(data[8 : 8 + length]).get("__metadata__") or {}).get(_KEY)
    if text is None:
        why = f"the header has no metadata under {_KEY!r}; give a file that this project's training wrote"
        raise WeightsError(path, why)
    try:
        fields = json.loads(text)
        if fields["format"] != _FORMAT:
            why = f"the header has format {fields['format']!r}, this version reads {_FORMAT}; update the package"
            raise WeightsError(path, why)
        a, b = (float(value) for value in fields["calibration"])
        if not (math.isfinite(a) and math.isfinite(b)):
            raise WeightsError(path, f"the calibration ({a}, {b}) is not finite; calibrate again")
        return Header(
            network=str(fields["network"]),
            version=str(fields["version"]),
            configuration=dict(fields["configuration"]),
            calibration=(a, b),
            training=dict(fields["training"]),
        )
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        why = f"the header's metadata cannot be understood ({error!r}); give a file that this project's training wrote"
        raise WeightsError(path, why) from error


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
