"""`python -m simharness`: clear tables through the service and count.

`replay` shows one attempt again, `failures` sorts failed attempts by cause, `robustness` repeats a run under worse
sensing, `compare` with several networks, `paired` compares two runs scene by scene, `sizes` counts what one cleared by
size.

Exit codes: 0 the run is complete; 2 the command cannot be carried out; 3 the service or a worker failed in mid-run,
what was done is kept; 130 and 143 stopped by Ctrl-C and by SIGTERM.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from simharness.errors import RunBroken, SimError
from simharness.flags_from_settings import (
    compare_parser,
    failures_parser,
    out_of,
    paired_parser,
    replay_parser,
    robustness_parser,
    run_parser,
    settings_of,
    sizes_parser,
    trials_of,
)
from simharness.play.folder import FAILURES_FILE, PAGE_FILE, REPORT_FILE, SERVICE_LOG, RunFolder
from simharness.play.photographer import attempts_to_show, keep_only, take_pictures
from simharness.play.records import Run
from simharness.play.replay import find_attempt, replay
from simharness.play.round import camera_sensor
from simharness.play.run import Hooks, check_that_it_answers, run
from simharness.play.settings import RunSettings
from simharness.report.causes import failures, failures_report, failures_table
from simharness.report.compare import TABLE, Comparison
from simharness.report.page import page
from simharness.report.paired import paired, paired_table
from simharness.report.progress import Progress
from simharness.report.report import package_versions, report, table
from simharness.report.robustness import JSON_FILE, PLOT_FILE, TABLE_FILE, Study, conditions
from simharness.report.sizes import sizes, sizes_table
from simharness.sim.camera import check_sensing
from simharness.sim.objects import ObjectModel, load_object_set

if TYPE_CHECKING:
    from typing_extensions import Self

EXIT_USAGE = 2
EXIT_BROKEN = 3

PUBLISHED_CROP = "published-crop"
"""Folder, in that of a run of camera `giga`, of the same rounds with the crop that its published figures have."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out a command line; the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        for name, parser, carry_out in _COMMANDS:
            if given[:1] == [name]:
                return carry_out(parser().parse_args(given[1:]))
        return _run(run_parser().parse_args(given))
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
    settings = settings_of(options)
    folder = RunFolder(out_of(options, f"{settings.scene}-{settings.executor}"))
    _, code = _clear(options, settings, folder)
    if settings.calibrate and options.calibrate is None and not code:
        print(f"\n{PUBLISHED_CROP}: the same rounds without the table in view, as published", flush=True)
        settings = replace(settings, calibrate=False)
        _, code = _clear(options, settings, RunFolder(folder.path / PUBLISHED_CROP))
    return code


def _robustness(options: argparse.Namespace) -> int:
    settings = settings_of(options)
    folder = RunFolder(out_of(options, f"robustness-{settings.scene}-{settings.executor}"))
    study = Study(settings, options.against)
    of_name = {condition.name: condition for condition in conditions(options.against)}

    def take(name: str, result: Run) -> None:
        study.add(of_name[name], result)
        folder.write_json(JSON_FILE, study.report(package_versions()))
        folder.write_text(TABLE_FILE, study.table())
        folder.write_text(PLOT_FILE, study.plot())

    parts = [_Part(name, condition.settings(settings)) for name, condition in of_name.items()]
    code = _clear_each(options, parts, folder, take)
    print(f"\n{study.table()}\nplot      {folder.path / PLOT_FILE}")
    return code


def _compare(options: argparse.Namespace) -> int:
    trials = trials_of(options)
    folder = RunFolder(out_of(options, "compare"))
    comparison = Comparison(trials, package_versions())

    def take(name: str, result: Run) -> None:
        comparison.add(name, result)
        folder.write_json(f"{TABLE}.json", comparison.report())
        folder.write_text(f"{TABLE}.md", comparison.table())
        chart = comparison.chart()
        folder.write_text(f"{TABLE}.svg", chart.svg())
        chart.save_png(folder.path / f"{TABLE}.png")

    parts = [_Part(trial.name, trial.settings, trial.contestant.weights) for trial in trials]
    _check_networks(options, parts, folder)
    code = _clear_each(options, parts, folder, take)
    print(f"\n{comparison.table()}\nchart     {folder.path / TABLE}.svg, .png")
    return code


def _check_networks(options: argparse.Namespace, parts: Iterable[_Part], folder: RunFolder) -> None:
    """Ask every network that is still to play whether it is there: hours later is too late to hear that one is not.

    Raises:
        RunBroken: the service does not answer.
        UsageError: a network that is not there, or a folder that cannot be written.
    """
    folder.make()
    asked = set()
    for part in parts:
        contestant = (part.settings.model, part.weights)
        if contestant in asked or (options.resume and RunFolder(folder.path / part.name).is_complete(part.settings)):
            continue
        asked.add(contestant)
        check_that_it_answers(part.settings, options.url, part.weights, folder.path / SERVICE_LOG)


@dataclass(frozen=True, slots=True)
class _Part:
    """One run of several.

    Args:
        name: of its folder in the folder of all.
        settings: of the run.
        weights: that its service loads; None for what it loads by itself.
    """

    name: str
    settings: RunSettings
    weights: Path | None = None


def _clear_each(
    options: argparse.Namespace, parts: Iterable[_Part], folder: RunFolder, take: Callable[[str, Run], None]
) -> int:
    """Carry one run out after the other and hand each to `take` with its name; stops at one that breaks off."""
    for part in parts:
        print(f"\n{part.name}", flush=True)
        result, code = _clear(options, part.settings, RunFolder(folder.path / part.name), part.weights)
        if code:
            return code
        take(part.name, result)
    return 0


def _clear(
    options: argparse.Namespace, settings: RunSettings, folder: RunFolder, weights: Path | None = None
) -> tuple[Run, int]:
    """Carry a run out, leave its reports, print its table; the run and the exit code."""
    check_sensing(settings.camera, camera_sensor(settings))
    objects = _objects(settings)
    signals = _Signals()
    with ExitStack() as stack:
        progress = Progress(settings)
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
            weights=weights,
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


def _paired(options: argparse.Namespace) -> int:
    runs = [RunFolder(path) for path in (options.first, options.second)]
    settings = [folder.read_run()[0] for folder in runs]
    result = paired(runs[0].read_rounds(), runs[1].read_rounds(), np.random.default_rng(0))
    print(paired_table((str(options.first), str(options.second)), (settings[0], settings[1]), result))
    return 0


def _sizes(options: argparse.Namespace) -> int:
    folder = RunFolder(options.folder)
    settings, _, _ = folder.read_run()
    print(sizes_table(sizes(settings, _objects(settings), folder.read_rounds()), options.bins))
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


_COMMANDS = (
    ("replay", replay_parser, _replay),
    ("failures", failures_parser, _failures),
    ("robustness", robustness_parser, _robustness),
    ("compare", compare_parser, _compare),
    ("paired", paired_parser, _paired),
    ("sizes", sizes_parser, _sizes),
)


def _objects(settings: RunSettings) -> tuple[ObjectModel, ...]:
    return load_object_set(settings.objects, settings.scene, _path(settings.exclude), _path(settings.only))


def _path(name: str | None) -> Path | None:
    return None if name is None else Path(name)


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
