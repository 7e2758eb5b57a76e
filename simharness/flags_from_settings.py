"""The command lines of `python -m simharness` and what they ask for. It carries nothing out.

Flags that decide a run's results stand in `play/settings.py`: the fields of `RunSettings` say the type, the words and
the limits. Here are the commands, and the few flags that change no result.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Collection
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from simharness.errors import UsageError
from simharness.play.folder import FAILURES_FILE
from simharness.play.settings import Flag, Interval, Part, RunSettings, flags
from simharness.report.compare import TABLE as TABLE2
from simharness.report.compare import Contestant, Trial
from simharness.report.robustness import AXIS_NAMES, JSON_FILE, PLOT_FILE, TABLE_FILE
from simharness.sim.execute import Executor
from simharness.sim.objects import SceneKind

DEFAULT_OBJECTS: dict[SceneKind, str] = {"packed": "procedural", "pile": "pybullet-random"}
DEFAULT_WORKERS = min(2, os.cpu_count() or 1)
MAX_GRASPS_WATCHED = 10
MAX_PORT = 65535

_EXIT_CODES = (
    "Exit codes: 0 the run is complete; 2 the command cannot be carried out; 3 the service or a worker failed, and "
    "what was done is kept for --resume."
)


# What the flags ask for


def settings_of(options: argparse.Namespace) -> RunSettings:
    """The settings of a run, or those that all runs of a study have in common.

    Raises:
        UsageError: flags that do not go together.
    """
    seeds = tuple(options.seeds or [options.seed or 0])
    if len(set(seeds)) < len(seeds):
        raise UsageError(f"--seeds {' '.join(map(str, seeds))}: a seed is named twice; name each once")
    if options.watch and options.ray is not None:
        raise UsageError("--watch shows a worker of this machine; leave out --ray, or --watch")
    if options.resume and options.out is None:
        raise UsageError("--resume needs --out: the folder of the run to continue")
    given = {name: getattr(options, name) for name in flags()}
    given["objects"] = given["objects"] or DEFAULT_OBJECTS[options.scene]
    given |= {name: _absolute(given[name]) for name in ("objects", "exclude", "only")}
    if options.camera == "giga" and options.calibrate is None:
        given["calibrate"] = True
    return RunSettings(seeds=seeds, max_grasps=MAX_GRASPS_WATCHED if options.watch else 1, **given)


def out_of(options: argparse.Namespace, name: str) -> Path:
    """Where the reports go: a new folder in runs/, of a name and the time, unless one was given."""
    now = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    return options.out or Path("runs") / f"{name}-{now}"


def trials_of(options: argparse.Namespace) -> list[Trial]:
    """The runs of a comparison: for every scene and executor one with each network.

    Raises:
        UsageError: flags that do not go together, or one network twice.
    """
    contestants = [_contestant(text) for text in ",".join(options.models).split(",") if text]
    names = [contestant.name for contestant in contestants]
    if not names or len(set(names)) < len(names):
        raise UsageError(
            f"--models {' '.join(options.models)}: give networks of different names; of one with two weights files, "
            "the names are those of the files"
        )
    if options.url is not None and any(contestant.weights for contestant in contestants):
        raise UsageError("--models NAME=PATH is for services that are started here; leave out --url, or the paths")
    return [
        Trial(
            contestant,
            settings_of(
                argparse.Namespace(
                    **vars(options) | {"scene": scene, "executor": executor, "model": contestant.network}
                )
            ),
        )
        for scene in dict.fromkeys(options.scenes)
        for executor in dict.fromkeys(options.executors)
        for contestant in contestants
    ]


def _contestant(text: str) -> Contestant:
    network, given, path = text.strip().partition("=")
    if given and not Path(path).is_file():
        raise UsageError(f"--models {text}: there is no file {path or 'without a name'}; give NAME or NAME=PATH")
    return Contestant(network, Path(path).resolve() if given else None)


def _absolute(name: str | None) -> str | None:
    """A path that exists as an absolute one, so that a run is found again from anywhere; other names as they are."""
    return str(Path(name).resolve()) if name is not None and Path(name).exists() else name


# The commands


def run_parser() -> argparse.ArgumentParser:
    """Of the command without a name."""
    parser = argparse.ArgumentParser(
        prog="python -m simharness",
        description="Clear simulated tables through the grasp service and report success rates. Other commands: "
        "`replay DIR --attempt K` shows one attempt again, `failures DIR` sorts failed attempts by cause, `robustness` "
        "repeats a run under worse sensing, `compare` repeats it with several networks, `paired RUN RUN` compares two "
        "runs scene by scene; each has --help.",
        epilog=_EXIT_CODES,
        allow_abbrev=False,
    )
    _add_run_options(parser)
    _add_settings(parser, "camera")
    add = parser.add_argument
    add("--watch", action="store_true", help="show the run live in a browser page; plays with one worker")
    add(
        "--watch-port",
        type=_port,
        default=8080,
        metavar="PORT",
        help="port of that page; the next free one is taken (default %(default)s)",
    )
    return parser


def robustness_parser() -> argparse.ArgumentParser:
    """Of `robustness`, which has a camera of its own and makes its settings worse."""
    parser = argparse.ArgumentParser(
        prog="python -m simharness robustness",
        description="Play the same rounds, seen by camera `random`, under noise, from other viewpoints and with fewer "
        f"points; leaves a run for each condition and {TABLE_FILE}, {PLOT_FILE} and {JSON_FILE}.",
        epilog=_EXIT_CODES,
        allow_abbrev=False,
    )
    _add_run_options(parser)
    unchanged = {name: flag.default for name, (_, flag) in flags().items() if flag.part == "camera"}
    parser.set_defaults(watch=False, **unchanged)
    parser.add_argument(
        "--against",
        nargs="+",
        choices=AXIS_NAMES,
        default=AXIS_NAMES,
        help="what is made worse (default: everything)",
    )
    return parser


def compare_parser() -> argparse.ArgumentParser:
    """Of `compare`, which goes over scenes, executors and networks by itself."""
    parser = argparse.ArgumentParser(
        prog="python -m simharness compare",
        description="Play the same rounds with several networks, one after the other, each behind a service of its own "
        f"unless --url names one that has all of them; leaves a run for each and {TABLE2}.md, .json, .svg and .png, "
        "brought up to date after each. Differences are paired by scene, against tesnet or else the first network.",
        epilog=_EXIT_CODES,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add(
        "--models",
        nargs="+",
        required=True,
        metavar="NAME[=PATH]",
        help="networks, with spaces or commas between them; PATH is a weights file, by whose name it is then called",
    )
    add("--scenes", nargs="+", choices=get_args(SceneKind), default=get_args(SceneKind), help="default: both")
    add("--executors", nargs="+", choices=get_args(Executor), default=("edge",), help="default: edge")
    _add_run_options(parser, without=("scene", "executor", "model"))
    _add_settings(parser, "camera")
    parser.set_defaults(watch=False)
    return parser


def paired_parser() -> argparse.ArgumentParser:
    """Of `paired`."""
    parser = argparse.ArgumentParser(
        prog="python -m simharness paired",
        description="Compare two runs scene by scene: rates over the rounds that both have, and the first's minus the "
        "second's with an interval from the bootstrap over rounds.",
    )
    parser.add_argument("first", type=Path, metavar="RUN", help="the --out of a run")
    parser.add_argument("second", type=Path, metavar="RUN", help="the --out of the run to compare it with")
    return parser


def sizes_parser() -> argparse.ArgumentParser:
    """Of `sizes`."""
    parser = argparse.ArgumentParser(
        prog="python -m simharness sizes",
        description="Tell how many of the things of each size a run on a made set cleared.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="the --out of a run")
    parser.add_argument("--bins", type=_at_least(1), default=5, metavar="N", help="of size (default 5)")
    return parser


def replay_parser() -> argparse.ArgumentParser:
    """Of `replay`."""
    parser = argparse.ArgumentParser(
        prog="python -m simharness replay", description="Render one attempt of a run again."
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="the --out of a run")
    parser.add_argument(
        "--attempt",
        type=_at_least(0),
        required=True,
        metavar="K",
        help="which attempt: line of attempts.jsonl, the first is 0",
    )
    return parser


def failures_parser() -> argparse.ArgumentParser:
    """Of `failures`."""
    parser = argparse.ArgumentParser(
        prog="python -m simharness failures",
        description=f"Replay failed attempts of a run and sort them by cause; leaves {FAILURES_FILE} in its folder.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="the --out of a run")
    parser.add_argument(
        "--limit", type=_at_least(1), default=50, metavar="N", help="so many, the earliest (default %(default)s)"
    )
    return parser


def _add_run_options(parser: argparse.ArgumentParser, without: Collection[str] = ()) -> None:
    add = parser.add_argument
    _add_settings(parser, "round", without)
    seeds = parser.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=_at_least(0), metavar="SEED", help="run seed (default 0)")
    seeds.add_argument("--seeds", type=_at_least(0), nargs="+", metavar="SEED", help="several run seeds, pooled")
    add(
        "--workers",
        type=_at_least(1),
        default=DEFAULT_WORKERS,
        metavar="N",
        help="processes that play rounds; results do not depend on it (default %(default)s)",
    )
    _add_settings(parser, "model", without)
    add("--url", help="a running service (default: one is started for the run)")
    add(
        "--ray",
        metavar="ADDRESS",
        help="play the rounds on this Ray cluster; without --url every worker there has a service of its own",
    )
    add("--out", type=Path, metavar="DIR", help="where the reports go (default: a new folder in runs/)")
    add("--resume", action="store_true", help="continue the run in --out")


# Flags from settings


def _add_settings(parser: argparse.ArgumentParser, part: Part, without: Collection[str] = ()) -> None:
    for name, (kind, flag) in flags().items():
        if flag.part == part and name not in without:
            default = "" if flag.default is None else " (default %(default)s)"
            parser.add_argument(
                f"--{name.replace('_', '-')}", default=flag.default, help=flag.words + default, **_form(kind, flag)
            )


def _form(kind: Any, flag: Flag) -> dict[str, Any]:
    """How argparse is told what a flag takes."""
    if flag.choices is not None:
        return {"choices": flag.choices}
    kinds = {kind, *get_args(kind)}  # of `float | None` both
    for choice in kinds:
        if get_origin(choice) is Literal:
            return {"choices": get_args(choice)}
    if bool in kinds:
        return {"action": argparse.BooleanOptionalAction}
    parse: Any = str
    if flag.least is not None:
        parse = _at_least(flag.least)
    elif flag.within is not None:
        parse = _within(flag.within)
    return {"type": parse, "metavar": flag.placeholder}


def _at_least(minimum: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
        if value < minimum:
            raise argparse.ArgumentTypeError(f"{value} is too small; give {minimum} or more")
        return value

    return parse


def _within(allowed: Interval) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
        if value not in allowed:
            raise argparse.ArgumentTypeError(f"{text} is out of range; give {allowed}")
        return value

    return parse


def _port(text: str) -> int:
    port = _at_least(0)(text)
    if port > MAX_PORT:
        raise argparse.ArgumentTypeError(f"{port} is no port; give 0 to {MAX_PORT}")
    return port
