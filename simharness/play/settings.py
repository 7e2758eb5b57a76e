"""What a run is asked to do, and how people ask for each setting.

It knows neither the command line nor how rounds are played.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from simharness.sim.camera import Preset
from simharness.sim.execute import Executor
from simharness.sim.objects import SceneKind
from simharness.sim.sensors.catalogue import SensorName
from tesnet.hands import HANDS, KnownHand

Part = Literal["round", "model", "camera"]


@dataclass(frozen=True, slots=True)
class Interval:
    """The numbers that a setting may have.

    Args:
        low, high: limits, of which `high` is too much.
        unit: of all three.
        from_low: whether `low` itself is allowed.
    """

    low: float
    high: float
    unit: str
    from_low: bool = False

    def __contains__(self, value: float) -> bool:
        return self.low < value < self.high or (self.from_low and value == self.low)

    def __str__(self) -> str:
        least = f"{self.low:g} or more" if self.from_low else f"more than {self.low:g}"
        return f"{self.unit}, {least} and less than {self.high:g}"


@dataclass(frozen=True, slots=True)
class Flag:
    """How people ask for a setting.

    Args:
        part: what it is a setting of.
        words: what it decides, and what holds when nothing is said and there is no default.
        placeholder: stands for a value that is free.
        default: what holds when nothing is said.
        least: the smallest whole number that can be asked for.
        within: the numbers that can be asked for.
        choices: the words that can be asked for.
    """

    part: Part
    words: str
    placeholder: str | None = None
    default: Any = None
    least: int | None = None
    within: Interval | None = None
    choices: tuple[str, ...] | None = None


_NOISE = Interval(0, 1, "metres", from_low=True)


@dataclass(frozen=True, slots=True)
class RunSettings:
    """Everything that decides a run's results, apart from the model behind the service.

    Args:
        seeds: run seeds; the results of several are pooled.
        max_grasps: grasps requested for each observation; the first is executed.

    The others are what their flags say. Of the camera's, None is the preset's own.
    """

    rounds: Annotated[int, Flag("round", "rounds for each seed", "N", default=100, least=1)]
    seeds: tuple[int, ...]
    scene: Annotated[
        SceneKind, Flag("round", "packed: objects stand apart; pile: objects are poured", default="packed")
    ]
    objects: Annotated[
        str,
        Flag(
            "round",
            "procedural, pybullet-random, novel, flat, wide, a folder of URDF/OBJ files or a .txt list of them "
            "(default: procedural for packed, pybullet-random for pile scenes)",
            "NAME_OR_PATH",
        ),
    ]
    exclude: Annotated[str | None, Flag("round", "file with names of objects to leave out", "LIST")]
    only: Annotated[str | None, Flag("round", "file with names of objects to use alone", "LIST")]
    camera: Annotated[
        Preset,
        Flag(
            "camera",
            "random: one view from somewhere above; giga: one fixed view from the side; multi3: three views; "
            "vgn6: six views; top: one view from straight above",
            default="random",
        ),
    ]
    noise_std: Annotated[
        float | None,
        Flag(
            "camera",
            "noise on each coordinate of each point, metres (default: the camera's)",
            "M",
            within=_NOISE,
        ),
    ]
    depth_noise_std: Annotated[
        float | None, Flag("camera", "noise on depth, metres (default: the camera's)", "M", within=_NOISE)
    ]
    executor: Annotated[
        Executor,
        Flag(
            "round",
            "edge: contacts on the way push, as in published harnesses; strict: a contact before closing is a "
            "failure, and both fingers must hold the same object",
            default="edge",
        ),
    ]
    model: Annotated[str, Flag("model", "network to ask for", "NAME", default="tesnet")]
    max_grasps: int
    dex_noise: Annotated[
        bool | None, Flag("camera", "the depth noise that camera giga has (default: the camera's)")
    ] = None
    polar_deg: Annotated[
        float | None,
        Flag(
            "camera",
            "angle of the views from straight above (default: the camera's)",
            "DEG",
            within=Interval(0, 90, "degrees", from_low=True),
        ),
    ] = None
    voxel_size: Annotated[
        float | None,
        Flag(
            "camera",
            "thin the cloud to one point for each voxel of this edge, metres (default: every point is sent)",
            "M",
            within=Interval(0, 1, "metres"),
        ),
    ] = None
    sensor: Annotated[
        SensorName | None,
        Flag("camera", "what measures depth, as simharness/sim/sensors/catalogue.py has it (default: the camera's)"),
    ] = None
    distance: Annotated[
        float | None,
        Flag(
            "camera",
            "from the cameras to the middle of the table's top, at which they then look, metres "
            "(default: the camera's)",
            "M",
            within=Interval(0.2, 1.5, "metres"),
        ),
    ] = None
    table_in_view: Annotated[
        bool | None, Flag("camera", "send the table too, not what stands on it alone (default: with --calibrate alone)")
    ] = None

    calibrate: Annotated[
        bool | None,
        Flag(
            "camera",
            "have the service solve depth scale and tilt from the table in view (default: camera giga is played with "
            "it and, beside it, with the published crop; others without)",
        ),
    ] = None

    gripper: Annotated[
        str,
        Flag(
            "round",
            "the hand; objects are scaled by its opening",
            default="franka",
            choices=tuple(HANDS),
        ),
    ] = "franka"

    min_score: Annotated[
        float | None,
        Flag(
            "model",
            "look again from elsewhere where no grasp scores as much, and end the round after three such looks "
            "(default: every grasp is tried)",
            "P",
            within=Interval(0, 1, "a probability"),
        ),
    ] = None

    look_again_below: Annotated[
        float | None,
        Flag(
            "model",
            "while no grasp scores as much, look again from elsewhere and fuse what was seen; after three looks the "
            "best grasp is tried (default: one look for each attempt)",
            "P",
            within=Interval(0, 1, "a probability"),
        ),
    ] = None

    @property
    def hand(self) -> KnownHand:
        """The hand that `gripper` names."""
        return HANDS[self.gripper]

    @property
    def shows_table(self) -> bool:
        """Whether the table is in the clouds that are sent."""
        return bool(self.calibrate if self.table_in_view is None else self.table_in_view)

    def to_json(self) -> dict[str, Any]:
        """The settings as JSON values."""
        return {**asdict(self), "seeds": list(self.seeds)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> RunSettings:
        """Settings from `to_json`; runs recorded before an option existed were played without it.

        Raises:
            TypeError: a field without a default is missing, or one is unknown.
        """
        return cls(**{**values, "seeds": tuple(values["seeds"])})


def flags() -> dict[str, tuple[Any, Flag]]:
    """Type and flag of every setting that has one, by the setting's name."""
    hints = get_type_hints(RunSettings, include_extras=True)
    annotated = {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Annotated}
    return {name: (kind, flag) for name, (kind, flag) in annotated.items()}
