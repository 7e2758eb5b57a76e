"""Object sets: what counts as an object, how lists choose, and what is said about a broken file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from simharness.errors import ObjectSetError, SimError
from simharness.sim import procedural
from simharness.sim.objects import (
    BROKEN_RANDOM_URDFS,
    RANDOM_URDF_MIDDLE_EXTENT,
    ObjectModel,
    _Entry,
    default_cache_dir,
    load_object_set,
)

CUBE = """\
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 2 3 7
f 2 7 6
f 3 4 8
f 3 8 7
f 4 1 5
f 4 5 8
"""
URDF = """\
<robot name="thing"><link name="base">
  <visual><geometry><mesh filename="{mesh}" scale="{scale} {scale} {scale}"/></geometry></visual>
  <collision><geometry><mesh filename="{mesh}" scale="{scale} {scale} {scale}"/></geometry></collision>
</link></robot>
"""


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder / "tes-net"


def add_cube(folder: Path, name: str, size: float = 0.05) -> Path:
    """A URDF and, in a folder of its own, the mesh it refers to."""
    urdf = folder / f"{name}.urdf"
    mesh = urdf.parent / "meshes" / f"{urdf.stem}.obj"
    mesh.parent.mkdir(parents=True, exist_ok=True)
    mesh.write_text(CUBE)
    urdf.write_text(URDF.format(mesh=f"meshes/{urdf.stem}.obj", scale=size))
    return urdf


def add_bare(folder: Path, name: str, size: float = 0.05) -> Path:
    path = folder / f"{name}.obj"
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [
        "v " + " ".join(str(float(word) * size) for word in line.split()[1:]) if line.startswith("v") else line
        for line in CUBE.splitlines()
    ]
    path.write_text("\n".join(lines))
    return path


def write_list(path: Path, *names: str) -> Path:
    path.write_text("# a comment\n\n" + "".join(f"{name}  # why\n" for name in names))
    return path


def names_of(models: tuple[ObjectModel, ...]) -> list[str]:
    return [model.name for model in models]


# --- folders and lists


def test_a_mesh_that_a_urdf_refers_to_is_not_an_object_of_its_own(tmp_path: Path) -> None:
    add_cube(tmp_path, "b")
    add_cube(tmp_path, "deep/er/a")
    add_bare(tmp_path, "c")
    models = load_object_set(str(tmp_path), "pile")
    assert names_of(models) == ["b", "c", "deep/er/a"]
    assert all(model.scale_hint == 1.0 and model.urdf.is_file() for model in models)


@pytest.mark.parametrize(
    "mesh", ["package://things/meshes/can.obj", "package://meshes/can.obj", "file://{folder}/meshes/can.obj"]
)
def test_the_mesh_of_a_uri_is_found_where_the_simulator_finds_it(tmp_path: Path, mesh: str) -> None:
    folder = tmp_path / "things"
    urdf = add_cube(folder, "can")
    urdf.write_text(URDF.format(mesh=mesh.format(folder=folder), scale=0.05))
    assert load_object_set(str(folder), "pile") == (ObjectModel("can", urdf),)


def test_a_urdf_wins_over_a_bare_mesh_of_the_same_name(tmp_path: Path) -> None:
    urdf = add_cube(tmp_path, "can")
    add_bare(tmp_path, "can")
    assert load_object_set(str(tmp_path), "pile") == (ObjectModel("can", urdf),)


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply"])
def test_a_bare_mesh_becomes_a_urdf_centred_on_its_bounding_box(tmp_path: Path, suffix: str) -> None:
    mesh = trimesh.creation.box((0.02, 0.04, 0.06))
    mesh.apply_translation([0.1, 0.2, 0.3])
    mesh.export(tmp_path / f"brick & mortar.{suffix}")
    (model,) = load_object_set(str(tmp_path), "pile")
    assert model.name == "brick & mortar"
    assert 'xyz="-0.1' in model.urdf.read_text()
    assert load_object_set(str(tmp_path), "pile") == (model,), "the cached file serves again"


def test_a_changed_bare_mesh_is_never_served_from_the_cache(tmp_path: Path) -> None:
    add_bare(tmp_path, "brick", 0.05)
    (before,) = load_object_set(str(tmp_path), "pile")
    add_bare(tmp_path, "brick", 0.06)
    (after,) = load_object_set(str(tmp_path), "pile")
    assert before.urdf != after.urdf
    assert "-0.03" in after.urdf.read_text()


def test_a_folder_with_both_kinds_of_scene_is_chosen_from_by_the_scene(tmp_path: Path) -> None:
    for name in ("packed/train/mug", "pile/train/mug", "pile/train/fork"):
        add_cube(tmp_path, name)
    assert names_of(load_object_set(str(tmp_path), "packed")) == ["packed/train/mug"]
    assert names_of(load_object_set(str(tmp_path), "pile")) == ["pile/train/fork", "pile/train/mug"]
    assert names_of(load_object_set(str(tmp_path / "packed"), "pile")) == ["train/mug"]


def test_a_list_names_paths_relative_to_its_own_folder(tmp_path: Path) -> None:
    for name in ("packed/train/mug", "pile/train/fork", "pile/train/knife"):
        add_cube(tmp_path, name)
    chosen = write_list(tmp_path / "val.txt", "packed/train/mug", "pile/train/knife", "pile/train/knife.urdf")
    assert names_of(load_object_set(str(chosen), "packed")) == ["packed/train/mug"]
    assert names_of(load_object_set(str(chosen), "pile")) == ["pile/train/knife"]


def test_objects_come_sorted_whatever_the_order_of_the_list(tmp_path: Path) -> None:
    for name in "cab":
        add_cube(tmp_path, name)
    assert names_of(load_object_set(str(write_list(tmp_path / "l.txt", "c", "a", "b")), "pile")) == ["a", "b", "c"]


# --- exclude and only


@pytest.mark.parametrize("folder", ["", "packed", "packed/train"])
@pytest.mark.parametrize(
    "entry", ["mug", "train/mug", "packed/train/mug", "./packed/train/mug.urdf", "objects/packed/train/MUG"]
)
def test_an_excluded_object_stays_out_however_deep_the_folder(tmp_path: Path, folder: str, entry: str) -> None:
    for name in ("packed/train/mug", "packed/train/bug", "packed/train/big_mug"):
        add_cube(tmp_path / "objects", name)
    exclude = write_list(tmp_path / "exclude.txt", entry)
    left = load_object_set(str(tmp_path / "objects" / folder), "packed", exclude=exclude)
    assert [Path(model.name).name for model in left] == ["big_mug", "bug"]


def test_exclude_and_only_split_a_set_in_two(tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d"):
        add_cube(tmp_path, name)
    chosen = write_list(tmp_path / "val.list", "pile/train/b", "pile/train/d")
    kept = load_object_set(str(tmp_path), "pile", only=chosen)
    left = load_object_set(str(tmp_path), "pile", exclude=chosen)
    assert names_of(kept) == ["b", "d"]
    assert names_of(left) == ["a", "c"]


def test_an_excluded_object_may_be_broken(tmp_path: Path) -> None:
    add_cube(tmp_path, "good")
    (tmp_path / "bad.urdf").write_text("<robot")
    exclude = write_list(tmp_path / "x.txt", "bad")
    assert names_of(load_object_set(str(tmp_path), "pile", exclude=exclude)) == ["good"]
    with pytest.raises(ObjectSetError, match=r"bad\.urdf: not XML"):
        load_object_set(str(tmp_path), "pile")


PATHS = st.lists(st.text("aBc_0.", min_size=1).filter(lambda part: part.strip(".") == part), min_size=1, max_size=4)


@given(PATHS, PATHS)
def test_matching_is_symmetric_and_meets_every_ending(one: list[str], other: list[str]) -> None:
    a, b = "/".join(one), "/".join(other)
    assert _Entry.parse(a).matches(b) == _Entry.parse(b).matches(a)
    for start in range(len(one)):
        assert _Entry.parse("/".join(one[start:])).matches(a)
    assert _Entry.parse(f"{b}/{a}").matches(a)


# --- built-in sets


def test_random_urdfs_fit_the_hand() -> None:
    models = load_object_set("pybullet-random", "pile")
    assert names_of(models) == [f"pybullet-random/{number}" for number in range(900, 1000)]
    assert all(0.3 < model.scale_hint <= 1.0 for model in models)
    lines = models[0].urdf.with_suffix(".obj").read_text().splitlines()
    vertices = np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=float)
    extents = np.ptp(vertices, axis=0) * 0.015 * models[0].scale_hint
    assert np.sort(extents)[1] <= RANDOM_URDF_MIDDLE_EXTENT + 1e-6


def test_random_training_urdfs_are_others_and_leave_out_the_broken(tmp_path: Path) -> None:
    names = [f"{number:03d}" for number in range(900)]
    whole = [name for name in names if name not in BROKEN_RANDOM_URDFS]
    few = write_list(tmp_path / "few.txt", *whole[::100])
    assert names_of(load_object_set("pybullet-random-train", "pile", only=few)) == [
        f"pybullet-random/{name}" for name in whole[::100]
    ]
    for name in (*BROKEN_RANDOM_URDFS, "900"):
        with pytest.raises(ObjectSetError, match=name):
            load_object_set("pybullet-random-train", "pile", only=write_list(tmp_path / "one.txt", name))


def test_procedural_training_objects_are_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(procedural.OBJECTS_PER_FAMILY, "train", 1)
    monkeypatch.setitem(procedural.OBJECTS_PER_FAMILY, "test", 1)
    test, train = load_object_set("procedural", "packed"), load_object_set("procedural-train", "packed")
    assert len(test) == len(train) == len(procedural.FAMILIES)
    assert not set(names_of(test)) & set(names_of(train))
    assert not {model.urdf for model in test} & {model.urdf for model in train}


def test_procedural_objects_are_written_once_and_made_again_when_lost(cache: Path) -> None:
    models = load_object_set("procedural", "packed")
    assert all(cache in model.urdf.parents for model in models)
    written = {path: path.stat().st_mtime_ns for path in cache.rglob("*.*")}
    lost = models[0].urdf.with_name("collision.obj")
    content = lost.read_bytes()
    lost.unlink()
    assert load_object_set("procedural", "packed") == models
    assert lost.read_bytes() == content
    again = models[1].urdf
    assert again.stat().st_mtime_ns == written[again]
    assert not list(cache.rglob(".*")), "no temporary file is left behind"


def test_a_built_in_set_can_be_excluded_from(tmp_path: Path) -> None:
    exclude = write_list(tmp_path / "x.txt", "mug_00", "procedural/test/bowl_01")
    left = set(names_of(load_object_set("procedural", "packed", exclude=exclude)))
    assert set(procedural.object_names("test")) - left == {"procedural/test/mug_00", "procedural/test/bowl_01"}


@pytest.mark.parametrize("configured", ["", "not/absolute"])
def test_the_cache_falls_back_to_the_home_folder(monkeypatch: pytest.MonkeyPatch, configured: str) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", configured)
    assert default_cache_dir() == Path.home() / ".cache" / "tes-net"


# --- errors


def test_errors_say_value_limit_and_remedy(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ObjectSetError, match="holds no object") as caught:
        load_object_set(str(tmp_path / "empty"), "pile")
    assert isinstance(caught.value, SimError)
    for text in (caught.value.value, caught.value.limit, caught.value.remedy):
        assert text
        assert text in str(caught.value)


def test_an_unknown_set_names_the_choices(tmp_path: Path) -> None:
    with pytest.raises(ObjectSetError, match=r"procedural-train.*a folder"):
        load_object_set(str(tmp_path / "nowhere"), "pile")
    with pytest.raises(ObjectSetError, match="single file"):
        load_object_set(str(add_cube(tmp_path, "cube")), "pile")


@pytest.mark.parametrize("role", ["spec", "only"])
def test_a_list_that_names_a_missing_object_is_refused(tmp_path: Path, role: str) -> None:
    add_cube(tmp_path, "mug")
    names = write_list(tmp_path / "names.txt", "mug", "jug")
    spec, only = (names, None) if role == "spec" else (tmp_path, names)
    with pytest.raises(ObjectSetError, match="jug"):
        load_object_set(str(spec), "pile", only=only)


def test_missing_and_empty_lists_are_refused(tmp_path: Path) -> None:
    add_cube(tmp_path, "mug")
    with pytest.raises(ObjectSetError, match=r"none\.txt"):
        load_object_set(str(tmp_path), "pile", exclude=tmp_path / "none.txt")
    with pytest.raises(ObjectSetError, match="no object"):
        load_object_set(str(write_list(tmp_path / "empty.txt")), "pile")
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ObjectSetError, match="UTF-8"):
        load_object_set(str(tmp_path / "bytes.txt"), "pile")


def test_a_set_with_everything_excluded_is_refused(tmp_path: Path) -> None:
    add_cube(tmp_path, "mug")
    with pytest.raises(ObjectSetError, match="no object is left"):
        load_object_set(str(tmp_path), "pile", exclude=write_list(tmp_path / "all.txt", "mug"))


BREAKAGES = {
    "0 bytes": "",
    "cannot be read": "v 1 2\nv one two three\nf 1 2 3\n",
    "no vertices": "f 1 2 3\n",
    "faces": CUBE.partition("f")[0],
    "NaN": CUBE.replace("v 1 1 1", "v 1 nan 1"),
    "no volume": CUBE.replace(" 1\nv", " 0\nv").replace("v 0 1 1", "v 0 1 0"),
}


@pytest.mark.parametrize("complaint", BREAKAGES)
@pytest.mark.parametrize("bare", [False, True])
def test_a_broken_mesh_is_named_with_what_is_wrong(tmp_path: Path, complaint: str, bare: bool) -> None:
    broken = add_bare(tmp_path, "thing") if bare else add_cube(tmp_path, "thing").parent / "meshes" / "thing.obj"
    broken.write_text(BREAKAGES[complaint])
    with pytest.raises(ObjectSetError, match=complaint) as caught:
        load_object_set(str(tmp_path), "pile")
    assert "thing.obj" in caught.value.value
    assert "exclude" in caught.value.remedy


@pytest.mark.parametrize(("size", "remark"), [(50.0, "50 m across"), (0.001, "0.001 m across")])
def test_an_absurd_size_is_refused(tmp_path: Path, size: float, remark: str) -> None:
    add_cube(tmp_path, "thing", size)
    with pytest.raises(ObjectSetError, match=remark) as caught:
        load_object_set(str(tmp_path), "pile")
    assert "metres" in caught.value.remedy


def test_a_mesh_that_is_not_there_is_refused(tmp_path: Path) -> None:
    (add_cube(tmp_path, "thing").parent / "meshes" / "thing.obj").unlink()
    with pytest.raises(ObjectSetError, match=r"meshes/thing\.obj"):
        load_object_set(str(tmp_path), "pile")


def test_a_robot_is_not_an_object(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text('<robot name="arm"><link name="a"/><link name="b"/></robot>')
    with pytest.raises(ObjectSetError, match="2 links"):
        load_object_set(str(tmp_path), "pile")


def test_a_file_repaired_in_place_is_read_again(tmp_path: Path) -> None:
    mesh = add_cube(tmp_path, "thing").parent / "meshes" / "thing.obj"
    mesh.write_text(CUBE.replace("v 1 1 1", "v 1 nan 1"))
    with pytest.raises(ObjectSetError):
        load_object_set(str(tmp_path), "pile")
    mesh.write_text(CUBE)
    os.utime(mesh, ns=(1, 1))
    assert names_of(load_object_set(str(tmp_path), "pile")) == ["thing"]


def test_primitives_are_measured_with_their_rotation(tmp_path: Path) -> None:
    shape = '<origin xyz="0 0 0.1" rpy="0 1.5708 0"/><geometry><box size="0.02 0.03 0.04"/></geometry>'
    (tmp_path / "box.urdf").write_text(f'<robot name="b"><link name="l"><collision>{shape}</collision></link></robot>')
    assert names_of(load_object_set(str(tmp_path), "pile")) == ["box"]


@pytest.mark.parametrize(
    ("solid", "said"),
    [
        ('<box size="2.5 0.02 0.03"/>', "2.5 m"),
        ('<box size="0.02 2.5 0.03"/>', "2.5 m"),
        ('<box size="0.02 0.03 2.5"/>', "2.5 m"),
        ('<sphere radius="1.25"/>', "2.5 m"),
        ('<cylinder radius="0.02" length="2.5"/>', "2.5 m"),
        ('<cylinder radius="1.25" length="0.02"/>', "2.5 m"),
        ('<capsule radius="0.25" length="2"/>', "2.5 m"),
    ],
)
def test_primitives_are_as_large_as_they_say(tmp_path: Path, solid: str, said: str) -> None:
    shape = f"<collision><geometry>{solid}</geometry></collision>"
    (tmp_path / "solid.urdf").write_text(f'<robot name="b"><link name="l">{shape}</link></robot>')
    with pytest.raises(ObjectSetError, match=rf"{said} across"):
        load_object_set(str(tmp_path), "pile")


def test_an_unwritable_cache_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ObjectSetError, match="XDG_CACHE_HOME"):
        load_object_set("procedural", "packed", cache_dir=tmp_path / "file")
