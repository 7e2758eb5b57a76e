"""`python -m simharness`: clear tables through the service and count.

`replay` shows one attempt again, `failures` sorts failed attempts by cause, `robustness` repeats a run under worse
sensing.

Exit codes: 0 the run is complete; 2 the command cannot be carried out; 3 the service or a worker failed in mid-run,
what was done is kept; 130 and 143 stopped by Ctrl-C and by SIGTERM.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import datetime, timezone
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, get_args

from tqdm import tqdm

from simharness.errors import RunBroken, SimError, UsageError
from simharness.play.folder import FAILURES_FILE, PAGE_FILE, REPORT_FILE, RunFolder
from simharness.play.metrics import summarise
from simharness.play.photographer import attempts_to_show, keep_only, take_pictures
from simharness.play.records import RoundRecord, Run, RunSettings
from simharness.play.replay import find_attempt, replay
from simharness.play.run import Hooks, run
from simharness.report.causes import failures, failures_report, failures_table
from simharness.report.page import page
from simharness.report.report import package_versions, percent, report, table
from simharness.report.robustness import AXIS_NAMES, JSON_FILE, PLOT_FILE, TABLE_FILE, Study, conditions
from simharness.sim.camera import PRESETS
from simharness.sim.execute import Executor
from simharness.sim.objects import ObjectModel, SceneKind, load_object_set

if TYPE_CHECKING:
    from typing_extensions import Self

EXIT_USAGE = 2
EXIT_BROKEN = 3

_EXIT_CODES = (
    "Exit codes: 0 the run is complete; 2 the command cannot be carried out; 3 the service or a worker failed, and "
    "what was done is kept for --resume."
)

DEFAULT_OBJECTS: dict[SceneKind, str] = {"packed": "procedural", "pile": "pybullet-random"}
DEFAULT_WORKERS = min(2, os.cpu_count() or 1)
MAX_GRASPS_WATCHED = 10
MAX_PORT = 65535


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out a command line; the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        for name, parser, carry_out in _COMMANDS:
            if given[:1] == [name]:
                return carry_out(parser().parse_args(given[1:]))
        return _run(_run_parser().parse_args(given))
    except RunBroken as error:
        return _fail(error, EXIT_BROKEN)
    except SimError as error:
        return _fail(error, EXIT_USAGE)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _fail(error: SimError, code: int) -> int:
    print(f"simharness: {error}", file=sys.stderr)
    return code


def _run(options: argparse.Namespace) -> int:
    settings = _settings(options)
    _, code = _clear(options, settings, RunFolder(options.out or _default_out(settings)))
    return code


def _robustness(options: argparse.Namespace) -> int:
    settings = _settings(options)
    folder = RunFolder(options.out or _default_out(settings, "robustness-"))
    study = Study(settings, options.against)
    code = 0
    for condition in conditions(options.against):
        print(f"\n{condition.name}", flush=True)
        result, code = _clear(options, condition.settings(settings), RunFolder(folder.path / condition.name))
        if code:
            break
        study.add(condition, result)
    folder.write_json(JSON_FILE, study.report(package_versions()))
    folder.write_text(TABLE_FILE, study.table())
    folder.write_text(PLOT_FILE, study.plot())
    print(f"\n{study.table()}\nplot      {folder.path / PLOT_FILE}")
    return code


def _clear(options: argparse.Namespace, settings: RunSettings, folder: RunFolder) -> tuple[Run, int]:
    """Carry a run out, leave its reports, print its table; the run and the exit code."""
    objects = _objects(settings)
    signals = _Signals()
    with ExitStack() as stack:
        progress = _Progress(settings)
        stack.callback(progress.close)
        stack.enter_context(signals)
        event = None
        if options.watch:
            # viser is needed for --watch alone.
            from simharness.report.watch import Watcher  # noqa: PLC0415

            watcher = stack.enter_context(Watcher(options.watch_port))
            print(f"watch: {watcher.url}", file=sys.stderr, flush=True)
            event = watcher
            progress.also(watcher.show_summary)
        result = run(
            settings,
            objects,
            folder,
            workers=1 if options.watch else options.workers,
            url=options.url,
            ray=options.ray,
            resume=options.resume,
            hooks=Hooks(progress.start, progress.add, event),
        )
    _leave(result, folder)
    print(table(result))
    print(f"report    {folder.path / PAGE_FILE}")
    if signals.caught is not None:
        return result, 128 + signals.caught
    if result.stopped_by is not None:
        print(f"simharness: {result.stopped_by}", file=sys.stderr)
        return result, EXIT_BROKEN
    return result, 0


def _leave(result: Run, folder: RunFolder) -> None:
    """Write the reports."""
    shown = attempts_to_show(result.rounds, result.settings.seeds[0])
    if result.complete:
        keep_only(folder.pictures, shown)
    content = report(result, package_versions())
    folder.write_json(REPORT_FILE, content)
    folder.write_text(PAGE_FILE, page(result, content, shown, folder.pictures))


def _replay(options: argparse.Namespace) -> int:
    folder = RunFolder(options.folder)
    settings, _, _ = folder.read_run()
    rounds = folder.read_rounds()
    recorded = find_attempt(rounds, options.attempt)
    objects = _objects(settings)
    played = next(record for record in rounds if (record.seed, record.round) == (recorded.seed, recorded.round))
    event = replay(settings, objects, played, recorded.attempt)[-1]
    target = folder.path / f"replay-{options.attempt}"
    target.mkdir(exist_ok=True)
    print(f"attempt {options.attempt}: seed {recorded.seed}, round {recorded.round}, its attempt {recorded.attempt}")
    lifted = f" ({', '.join(event.record.grasped)})" if event.record.grasped else ""
    print(f"outcome {event.record.outcome}{lifted}, score {recorded.score:.3f}; recorded {recorded.outcome}")
    for picture in take_pictures(event):
        path = target / picture.name
        path.write_bytes(picture.content)
        print(path)
    return 0


def _failures(options: argparse.Namespace) -> int:
    folder = RunFolder(options.folder)
    settings, _, _ = folder.read_run()
    rounds = folder.read_rounds()
    attempts = [attempt for record in rounds for attempt in record.attempts]
    failed = sum(not attempt.success for attempt in attempts)
    found = list(
        tqdm(
            failures(settings, _objects(settings), rounds, options.limit),
            total=min(failed, options.limit),
            unit="failure",
            file=sys.stderr,
            dynamic_ncols=True,
        )
    )
    content = failures_report(found, len(attempts), failed)
    folder.write_json(FAILURES_FILE, content)
    print(failures_table(content))
    return 0


def _run_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simharness",
        description="Clear simulated tables through the grasp service and report success rates. Other commands: "
        "`replay DIR --attempt K` shows one attempt again, `failures DIR` sorts failed attempts by cause, `robustness` "
        "repeats a run under worse sensing; each has --help.",
        epilog=_EXIT_CODES,
        allow_abbrev=False,
    )
    _add_run_options(parser)
    _add_camera_options(parser)
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


def _robustness_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simharness robustness",
        description="Play the same rounds, seen by camera `random`, under noise, from other viewpoints and with fewer "
        f"points; leaves a run for each condition and {TABLE_FILE}, {PLOT_FILE} and {JSON_FILE}.",
        epilog=_EXIT_CODES,
        allow_abbrev=False,
    )
    _add_run_options(parser)
    unchanged = {"camera": "random", "watch": False}
    changed = dict.fromkeys(("noise_std", "depth_noise_std", "dex_noise", "polar_deg", "voxel_size"))
    parser.set_defaults(**unchanged, **changed)
    parser.add_argument(
        "--against",
        nargs="+",
        choices=AXIS_NAMES,
        default=AXIS_NAMES,
        help="what is made worse (default: everything)",
    )
    return parser


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--rounds", type=_at_least(1), default=100, metavar="N", help="rounds for each seed (default %(default)s)")
    add(
        "--scene",
        choices=get_args(SceneKind),
        default="packed",
        help="packed: objects stand apart; pile: objects are poured (default %(default)s)",
    )
    add(
        "--objects",
        metavar="NAME_OR_PATH",
        help="procedural, pybullet-random, a folder of URDF/OBJ files or a .txt list of them "
        "(default: procedural for packed, pybullet-random for pile scenes)",
    )
    add("--exclude", metavar="LIST", help="file with names of objects to leave out")
    add("--only", metavar="LIST", help="file with names of objects to use alone")
    add(
        "--executor",
        choices=get_args(Executor),
        default="edge",
        help="edge: contacts on the way push, as in published harnesses; strict: a contact before closing is a "
        "failure, and both fingers must hold the same object (default %(default)s)",
    )
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
    add("--model", default="tesnet", metavar="NAME", help="network to ask for (default %(default)s)")
    add("--url", help="a running service (default: one is started for the run)")
    add(
        "--ray",
        metavar="ADDRESS",
        help="play the rounds on this Ray cluster; without --url every worker there has a service of its own",
    )
    add("--out", type=Path, metavar="DIR", help="where the reports go (default: a new folder in runs/)")
    add("--resume", action="store_true", help="continue the run in --out")


def _add_camera_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--camera",
        choices=PRESETS,
        default="random",
        help="random: one view from somewhere above; giga: one fixed view from the side; multi3: three views; "
        "vgn6: six views (default %(default)s)",
    )
    add(
        "--noise-std",
        type=_not_negative,
        metavar="M",
        help="noise on each coordinate of each point, metres (default: the camera's)",
    )
    add("--depth-noise-std", type=_not_negative, metavar="M", help="noise on depth, metres (default: the camera's)")
    add(
        "--dex-noise",
        action=argparse.BooleanOptionalAction,
        help="the depth noise that camera giga has (default: the camera's)",
    )
    add(
        "--polar-deg",
        type=_between(0, 90, "degrees"),
        metavar="DEG",
        help="angle of the views from straight above (default: the camera's)",
    )
    add(
        "--voxel-size",
        type=_between(0, 1, "metres"),
        metavar="M",
        help="thin the cloud to one point for each voxel of this edge, metres (default: every point is sent)",
    )


def _replay_parser() -> argparse.ArgumentParser:
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


def _failures_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m simharness failures",
        description=f"Replay failed attempts of a run and sort them by cause; leaves {FAILURES_FILE} in its folder.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="the --out of a run")
    parser.add_argument(
        "--limit", type=_at_least(1), default=50, metavar="N", help="so many, the earliest (default %(default)s)"
    )
    return parser


_COMMANDS = (
    ("replay", _replay_parser, _replay),
    ("failures", _failures_parser, _failures),
    ("robustness", _robustness_parser, _robustness),
)


def _settings(options: argparse.Namespace) -> RunSettings:
    seeds = tuple(options.seeds or [options.seed or 0])
    if len(set(seeds)) < len(seeds):
        raise UsageError(f"--seeds {' '.join(map(str, seeds))}: a seed is named twice; name each once")
    if options.watch and options.ray is not None:
        raise UsageError("--watch shows a worker of this machine; leave out --ray, or --watch")
    if options.resume and options.out is None:
        raise UsageError("--resume needs --out: the folder of the run to continue")
    return RunSettings(
        rounds=options.rounds,
        seeds=seeds,
        scene=options.scene,
        objects=_absolute(options.objects or DEFAULT_OBJECTS[options.scene]),
        exclude=_absolute(options.exclude),
        only=_absolute(options.only),
        camera=options.camera,
        noise_std=options.noise_std,
        depth_noise_std=options.depth_noise_std,
        executor=options.executor,
        model=options.model,
        max_grasps=MAX_GRASPS_WATCHED if options.watch else 1,
        dex_noise=options.dex_noise,
        polar_deg=options.polar_deg,
        voxel_size=options.voxel_size,
    )


def _objects(settings: RunSettings) -> tuple[ObjectModel, ...]:
    return load_object_set(settings.objects, settings.scene, _path(settings.exclude), _path(settings.only))


def _absolute(name: str | None) -> Any:
    """A path that exists as an absolute one, so that a run is found again from anywhere; other names as they are."""
    return str(Path(name).resolve()) if name is not None and Path(name).exists() else name


def _path(name: str | None) -> Path | None:
    return None if name is None else Path(name)


def _default_out(settings: RunSettings, prefix: str = "") -> Path:
    now = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%SZ")
    return Path("runs") / f"{prefix}{settings.scene}-{settings.executor}-{now}"


def _at_least(minimum: int) -> Any:
    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
        if value < minimum:
            raise argparse.ArgumentTypeError(f"{value} is too small; give {minimum} or more")
        return value

    return parse


def _port(text: str) -> int:
    port: int = _at_least(0)(text)
    if port > MAX_PORT:
        raise argparse.ArgumentTypeError(f"{port} is no port; give 0 to {MAX_PORT}")
    return port


def _not_negative(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0 <= value < 1:
        raise argparse.ArgumentTypeError(f"{text} is out of range; give metres, 0 or more and less than 1")
    return value


def _between(low: float, high: float, unit: str) -> Any:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
        if not low < value < high:
            raise argparse.ArgumentTypeError(
                f"{text} is out of range; give {unit}, more than {low:g} and less than {high:g}"
            )
        return value

    return parse


class _Progress:
    """A bar on stderr with the rates so far."""

    def __init__(self, settings: RunSettings) -> None:
        self._total = settings.rounds * len(settings.seeds)
        self._rounds: list[RoundRecord] = []
        self._bar: Any = None
        self._others: list[Any] = []

    def also(self, show: Any) -> None:
        self._others.append(show)

    def start(self, done: Sequence[RoundRecord]) -> None:
        self._rounds = list(done)
        self._bar = tqdm(total=self._total, initial=len(done), unit="round", file=sys.stderr, dynamic_ncols=True)
        self._show()

    def add(self, record: RoundRecord) -> None:
        self._rounds.append(record)
        self._bar.update()
        self._show()

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def _show(self) -> None:
        summary = summarise(self._rounds)
        self._bar.set_postfix_str(f"GSR {percent(summary.gsr)}, DR {percent(summary.dr)}")
        for show in self._others:
            show(summary)


class _Signals:
    """SIGTERM ends a run as Ctrl-C does; `caught` says which of the two came."""

    def __init__(self) -> None:
        self.caught: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._catch)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _catch(self, number: int, _frame: FrameType | None) -> None:
        if self.caught is None:  # a second one must not break off the tidying up
            self.caught = number
            raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
