from __future__ import annotations

import hashlib
import importlib
import json
import pickle
import sys
from contextlib import suppress
from pathlib import Path

import pytest
import safetensors.torch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tesnet import weights
from tesnet.errors import WeightsError
from tesnet.weights import Header

HEADER = Header(
    network="tesnet",
    version="1.2",
    configuration={"channels": [32, 64], "cloud": {"voxel": 0.0045, "neighbours": 16}, "activation": "relu"},
    calibration=(1.3, -0.4),
    training={"seed": 0, "data": "packed and pile", "metrics": {"accuracy": 0.9}},
)


def tensors() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        "layer.weight": torch.randn(4, 3, generator=generator),
        "layer.bias": torch.randn(4, generator=generator).double(),
        "steps": torch.tensor(7),
        "empty": torch.zeros(0, 2),
    }


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "net.safetensors"
    weights.save(path, tensors(), HEADER)
    return path


def with_metadata(path: Path, metadata: dict[str, str] | None) -> None:
    path.write_bytes(safetensors.torch.save(tensors(), metadata))


def edited(path: Path, **changes: object) -> None:
    """Rewrite some fields of the header's metadata."""
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    fields = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["tesnet"])
    with_metadata(path, {"tesnet": json.dumps(fields | changes)})


def refusal(path: Path) -> str:
    with pytest.raises(WeightsError) as caught:
        weights.load(path)
    assert caught.value.path == path
    assert str(path) in str(caught.value)
    return caught.value.why


def test_what_is_saved_is_loaded_bit_for_bit(path: Path) -> None:
    state_dict, header = weights.load(path)
    assert header == HEADER
    assert state_dict.keys() == tensors().keys()
    for name, tensor in tensors().items():
        assert state_dict[name].dtype == tensor.dtype
        assert torch.equal(state_dict[name], tensor)


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(), children, max_size=3),
    max_leaves=8,
)
finite = st.floats(allow_nan=False, allow_infinity=False)


def test_a_header_whose_length_looks_like_a_pickle_is_read(tmp_path: Path) -> None:
    path = tmp_path / "header.safetensors"
    for padding in range(1200):
        header = Header("n", "1", {"padding": "x" * padding})
        weights.save(path, {}, header)
        if path.read_bytes().startswith(b"\x80\x02"):
            assert weights.load(path)[1] == header
            return
    pytest.fail("no header of 640 bytes was written")


@given(
    configuration=st.dictionaries(st.text(), json_values, max_size=4),
    calibration=st.tuples(finite, finite),
    name=st.text(min_size=1),
)
@settings(max_examples=20, deadline=None)
def test_any_json_header_survives_the_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    configuration: dict[str, object],
    calibration: tuple[float, float],
    name: str,
) -> None:
    path = tmp_path_factory.getbasetemp() / "header.safetensors"
    header = Header(name, name, configuration, calibration, {"notes": configuration})
    weights.save(path, {}, header)
    assert weights.load(path)[1] == header


def test_equal_content_gives_equal_bytes(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    reordered = Header(
        HEADER.network,
        HEADER.version,
        dict(reversed(list(HEADER.configuration.items()))),
        HEADER.calibration,
        HEADER.training,
    )
    weights.save(other, dict(reversed(tensors().items())), reordered)
    assert other.read_bytes() == path.read_bytes()


def test_views_and_parameters_can_be_saved(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    shared = torch.arange(6.0)
    weights.save(path, {"row": shared[:3], "again": shared[:3], "turned": shared.view(2, 3).T}, HEADER)
    state_dict, _ = weights.load(path)
    assert torch.equal(state_dict["again"], shared[:3])
    assert torch.equal(state_dict["turned"], shared.view(2, 3).T)


def test_saving_creates_folders_and_leaves_no_other_file(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "net.safetensors"
    weights.save(path, tensors(), HEADER)
    assert list(path.parent.iterdir()) == [path]


def test_a_failed_save_leaves_the_old_file_and_no_other(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    before = path.read_bytes()
    monkeypatch.setattr("tesnet.whole_file.os.fsync", full)
    with pytest.raises(WeightsError, match="cannot be written: No space left on device"):
        weights.save(path, {"other": torch.zeros(3)}, HEADER)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_are_neither_saved_nor_loaded(path: Path, value: float) -> None:
    bad = {"fine": torch.ones(2), "layer.weight": torch.tensor([1.0, value])}
    before = path.read_bytes()
    with pytest.raises(WeightsError, match=r"layer\.weight holds 1 of 2 values that are not finite"):
        weights.save(path, bad, HEADER)
    assert path.read_bytes() == before
    path.write_bytes(safetensors.torch.save(bad))
    assert "layer.weight holds 1 of 2 values that are not finite" in refusal(path)


def test_a_header_that_is_not_json_is_not_saved(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    for configuration in ({"a": torch.zeros(1)}, {"a": float("nan")}):
        with pytest.raises(WeightsError, match="the header is not JSON"):
            weights.save(path, {}, Header("tesnet", "1", configuration))
    assert not path.exists()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "absent.safetensors")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    assert "cannot be read" in refusal(tmp_path)


@pytest.mark.parametrize("data", [b"", b"PLY", b"hello, this is text and no safetensors file", bytes(64), b"\xff" * 64])
def test_a_file_of_another_kind_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "net.safetensors"
    path.write_bytes(data)
    assert "is not a safetensors file" in refusal(path)


class Trap:
    """Unpickling this raises."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, ("raise SystemExit('a weights file ran code')",)


def test_a_pickle_is_refused_unopened(tmp_path: Path) -> None:
    new, old = tmp_path / "new.pt", tmp_path / "old.pt"
    torch.save({"layer": torch.zeros(2), "trap": Trap()}, new)
    old.write_bytes(pickle.dumps({"trap": Trap()}))
    for path in (new, old):
        assert "is a Python pickle" in refusal(path)


def test_a_file_cut_short_anywhere_is_refused(path: Path) -> None:
    data = path.read_bytes()
    for length in (*range(12), *range(12, len(data), 9), len(data) - 1):
        path.write_bytes(data[:length])
        why = refusal(path)
        assert f"is cut short after {length} bytes" in why or length <= 8


@given(position=st.integers(0, 400), flip=st.integers(1, 255))
@settings(max_examples=80, deadline=None)
def test_a_damaged_byte_raises_nothing_but_a_weights_error(
    tmp_path_factory: pytest.TempPathFactory, position: int, flip: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.safetensors"
    weights.save(path, tensors(), HEADER)
    data = bytearray(path.read_bytes())
    data[position % len(data)] ^= flip
    path.write_bytes(data)
    with suppress(WeightsError):  # names and values may change unnoticed where no checksum is listed
        weights.load(path)


@pytest.mark.parametrize("metadata", [None, {"format": "pt"}])
def test_a_file_without_this_projects_metadata_is_refused(path: Path, metadata: dict[str, str] | None) -> None:
    with_metadata(path, metadata)
    assert "has no metadata under 'tesnet'" in refusal(path)


@pytest.mark.parametrize("text", ["", "[]", "3", "{}", "{", '{"format": 1}', "[" * 100_000])
def test_metadata_that_cannot_be_understood_is_refused(path: Path, text: str) -> None:
    with_metadata(path, {"tesnet": text})
    assert "metadata cannot be understood" in refusal(path)


@pytest.mark.parametrize("calibration", [[1.0], ["a", 0], None, {"a": 1}])
def test_a_calibration_of_another_form_is_refused(path: Path, calibration: object) -> None:
    edited(path, calibration=calibration)
    assert "metadata cannot be understood" in refusal(path)


def test_a_calibration_that_is_not_finite_is_refused(path: Path) -> None:
    edited(path, calibration=[1.0, float("nan")])
    assert "the calibration (1.0, nan) is not finite" in refusal(path)


def test_a_header_of_another_format_is_refused(path: Path) -> None:
    edited(path, format=2)
    assert "the header has format 2, this version reads 1" in refusal(path)


def test_the_checksum_is_the_files(path: Path) -> None:
    assert weights.sha256(path) == hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(WeightsError, match="no such file"):
        weights.sha256(path.with_name("absent"))


@pytest.mark.parametrize("separator", ["  ", " *"])
def test_a_file_with_the_listed_checksum_loads(path: Path, separator: str) -> None:
    lines = f"{'0' * 64}{separator}other.safetensors\n\n{weights.sha256(path)}{separator}{path.name}\n"
    path.with_name(weights.SUMS).write_text(lines)
    assert weights.load(path)[1] == HEADER


def test_a_file_with_another_checksum_is_refused(path: Path) -> None:
    right, wrong = weights.sha256(path), "0" * 64
    path.with_name(weights.SUMS).write_text(f"{wrong}  {path.name}\n")
    why = refusal(path)
    assert right in why
    assert wrong in why


def test_a_file_that_no_checksum_lists_loads(path: Path) -> None:
    path.with_name(weights.SUMS).write_text(f"{'0' * 64}  other.safetensors\n")
    assert weights.load(path)[1] == HEADER


def test_checksums_that_cannot_be_read_are_not_ignored(path: Path) -> None:
    path.with_name(weights.SUMS).write_bytes(b"\xff\xfe\x00")
    assert "SHA256SUMS beside it cannot be read" in refusal(path)


SHAPES = {name: tuple(tensor.shape) for name, tensor in tensors().items()}


def test_tensors_of_the_expected_shapes_pass(path: Path) -> None:
    weights.verify(path, weights.load(path)[0], SHAPES)


@pytest.mark.parametrize(
    ("expected", "why"),
    [
        (SHAPES | {"layer.weight": (4, 6)}, r"tensor layer\.weight has shape \(4, 3\), the network wants \(4, 6\)"),
        (SHAPES | {"head.bias": (1,)}, r"lacks head\.bias of the network's 5 tensors"),
        (SHAPES | dict.fromkeys("abcde", (1,)), r"lacks a, b, c and 2 more of the network's 9 tensors"),
        ({k: v for k, v in SHAPES.items() if k != "steps"}, r"holds steps, which the network does not have"),
    ],
)
def test_other_names_or_shapes_are_refused(path: Path, expected: dict[str, tuple[int, ...]], why: str) -> None:
    with pytest.raises(WeightsError, match=why) as caught:
        weights.verify(path, tensors(), expected)
    assert caught.value.path == path


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A `weights` package with two networks, in the place of the project's."""
    folder = tmp_path / "weights"
    folder.mkdir()
    (folder / "__init__.py").touch()
    for name in ("tesnet", "gatv2"):
        weights.save(folder / f"{name}.safetensors", tensors(), HEADER)
    importlib.import_module("weights")  # so that monkeypatch puts the project's own back
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "weights")
    return folder


def test_shipped_weights_are_found_by_name(shipped: Path) -> None:
    assert weights.default_weights() == shipped / "tesnet.safetensors"
    assert weights.default_weights("gatv2") == shipped / "gatv2.safetensors"


@pytest.mark.parametrize("name", ["absent", "", "../weights/tesnet", "tesnet.safetensors"])
def test_another_name_is_refused_with_the_valid_ones(shipped: Path, name: str) -> None:
    with pytest.raises(WeightsError, match="there are: gatv2, tesnet"):
        weights.default_weights(name)
