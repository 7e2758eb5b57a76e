"""report.html: a run on one page that needs nothing beside it; pictures and drawings are inlined."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from simharness.play.metrics import Rate, Summary, summarise
from simharness.play.photographer import FAILURES, FIRST_ROUNDS, VIEWS, picture_name
from simharness.play.records import AttemptRecord, Run
from simharness.report.report import percent, times, title
from simharness.sim.outcome_kinds import OUTCOMES

_ENDS: Mapping[str, tuple[str, str]] = {
    "empty": ("the table is empty", "#16a34a"),
    "two_failures": ("attempts in a row failed", "#dc2626"),
    "no_grasps": ("three looks in a row gave none", "#64748b"),
}
"""What a round's end means, and its colour."""

_VIEW_TITLES = {
    "colour": "Camera, colour",
    "segmentation": "Camera, segmentation",
    "cloud": "Cloud with the executed grasp; grid 5 cm",
}
_UNSET = {
    "exclude": "none",
    "only": "none",
    "noise_std": "the camera's own",
    "depth_noise_std": "the camera's own",
    "dex_noise": "the camera's own",
    "polar_deg": "the camera's own",
    "voxel_size": "every point kept",
    "sensor": "the camera's own",
    "distance": "the camera's own",
    "table_in_view": "with calibration",
    "calibrate": "no",
    "min_score": "every grasp is tried",
    "look_again_below": "one look for each attempt",
    "url": "started for the run",
    "service_threads": "unknown",
    "device": "unknown",
}
"""What it means that a setting was not given."""


def page(run: Run, content: Mapping[str, Any], shown: Sequence[AttemptRecord], pictures: Path) -> str:
    """The page's HTML.

    Args:
        run: complete or not.
        content: of report.json.
        shown: attempts to show pictures of.
        pictures: the folder they lie in.
    """
    summary = summarise(run.rounds)
    sections = [
        f"<h1>Clutter removal, {run.settings.scene} scenes</h1>",
        f'<p class="subtitle">{escape(title(run.settings, run.model).replace(" | ", " · "))}</p>',
        "" if run.complete else _warning(run),
        '<div class="cards">',
        _rate_card("Grasp success rate (GSR)", summary.gsr, "grasps attempted"),
        _rate_card("Declutter rate (DR)", summary.dr, "objects on the tables"),
        "</div>",
        _seeds(run),
        '<h2>Outcomes</h2><div class="cards">',
        _outcomes(summary),
        _ends(summary),
        _latencies(summary),
        "</div>",
        _attempts(shown, pictures),
        "<h2>Settings</h2>",
        _table((_words(name), _setting(name, value)) for name, value in content["settings"].items()),
        "<h2>Model and packages</h2>",
        _table(
            [
                *((f"model {_words(name)}", str(value)) for name, value in (content["model"] or {}).items()),
                *content["versions"].items(),
            ]
        ),
    ]
    body = "\n".join(section for section in sections if section)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title(run.settings, run.model))}</title>\n<style>{_style()}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _style() -> str:
    return (resources.files("simharness.report") / "page.css").read_text(encoding="utf-8")


def _warning(run: Run) -> str:
    planned = run.settings.rounds * len(run.settings.seeds)
    return (
        f'<p class="warning"><b>Incomplete: {len(run.rounds)} of {planned} rounds.</b> '
        f"{escape(run.stopped_by or '')}</p>"
    )


def _rate_card(name: str, rate: Rate, what: str) -> str:
    return (
        f'<div class="card"><h3>{escape(name)}</h3><div class="value">{percent(rate)}</div>{_interval(rate)}'
        f'<div class="note">{rate.count} of {rate.total} {escape(what)}; 95 % Wilson interval '
        f"{_limits(rate)}</div></div>"
    )


def _limits(rate: Rate) -> str:
    low, high = rate.interval
    return f"{100 * low:.1f} to {100 * high:.1f} %"


def _interval(rate: Rate) -> str:
    """A bar from 0 to 100 % with the interval and the rate."""
    low, high = (100 * limit for limit in rate.interval)
    dot = "" if rate.value is None else f'<b style="left:{100 * rate.value:.2f}%"></b>'
    ticks = "".join(f'<span style="left:{at}%">{at}</span>' for at in (0, 25, 50, 75, 100))
    return (
        '<div class="interval" role="img" aria-label="rate with interval">'
        f'<div class="track"><i style="left:{low:.2f}%;width:{high - low:.2f}%"></i>{dot}</div>'
        f'<div class="ticks">{ticks}</div></div>'
    )


def _shares(entries: Sequence[tuple[str, int, str, str]]) -> str:
    """A bar divided in proportion to counts, and what its parts are: name, count, meaning, colour."""
    total = sum(count for _, count, _, _ in entries)
    pieces = "".join(
        f'<i style="flex-grow:{count};background:{colour}"></i>' for _, count, _, colour in entries if count
    )
    rows = "".join(
        f'<tr{"" if count else " class=none"}><td><i style="background:{colour}"></i>{escape(_words(name))}</td>'
        f"<td>{count}</td><td>{_share(count, total)}</td><td>{escape(meaning)}</td></tr>"
        for name, count, meaning, colour in entries
    )
    return (
        f'<div class="stack" role="img" aria-label="shares">{pieces}</div>'
        f'<table class="legend"><tbody>{rows}</tbody></table>'
    )


def _share(count: int, total: int) -> str:
    return f"{100 * count / total:.0f} %" if total else ""


def _outcomes(summary: Summary) -> str:
    counts = {"success": summary.gsr.count, **summary.failures}
    entries = [(kind, counts[kind], words.meaning, words.colour) for kind, words in OUTCOMES.items()]
    return f'<div class="card"><h3>Attempts by outcome</h3>{_shares(entries)}</div>'


def _ends(summary: Summary) -> str:
    entries = [(way, count, *_ENDS[way]) for way, count in summary.ended.items()]
    nothing = ", ".join(f"{escape(_words(reason))} {count}" for reason, count in summary.no_grasps.items()) or "none"
    return (
        f'<div class="card"><h3>Rounds by end</h3>{_shares(entries)}'
        f'<div class="note">Observations without a grasp: {nothing}</div></div>'
    )


def _latencies(summary: Summary) -> str:
    return (
        '<div class="card"><h3>Time of a request, median</h3>'
        f'<div class="value">{escape(_median(summary))}</div>'
        f'<div class="note">inside the service {times(summary.service_ms)}<br>'
        f"as the harness saw it {times(summary.round_trip_ms)}</div></div>"
    )


def _median(summary: Summary) -> str:
    median = summary.service_ms.median if summary.service_ms.median is not None else summary.round_trip_ms.median
    return "-" if median is None else f"{median:.0f} ms"


def _seeds(run: Run) -> str:
    if len(run.settings.seeds) < 2:
        return ""
    rows = ["<tr><th>seed</th><th>GSR</th><th>DR</th></tr>"]
    for seed in run.settings.seeds:
        summary = summarise(record for record in run.rounds if record.seed == seed)
        cells = "".join(
            f"<td>{percent(rate)} <small>{rate.count} of {rate.total}; {_limits(rate)}</small></td>"
            for rate in (summary.gsr, summary.dr)
        )
        rows.append(f"<tr><td>{seed}</td>{cells}</tr>")
    return f'<h2>By seed</h2><div class="table"><table>{"".join(rows)}</table></div>'


def _attempts(shown: Sequence[AttemptRecord], pictures: Path) -> str:
    cards = [_attempt(attempt, pictures) for attempt in shown]
    if not cards:
        return ""
    note = (
        f'<p class="subtitle">The first attempt of each of the first {FIRST_ROUNDS} rounds, then the earliest '
        f"failures, at most {FAILURES}. The score is the probability of success that the model gave.</p>"
    )
    return "\n".join(["<h2>Some of the attempts</h2>", note, *cards])


def _attempt(attempt: AttemptRecord, pictures: Path) -> str:
    figures = "".join(
        f'<figure><img alt="{_VIEW_TITLES[view]}" loading="lazy" src="data:image/png;base64,{_encoded(path)}">'
        f"<figcaption>{_VIEW_TITLES[view]}</figcaption></figure>"
        for view in VIEWS
        if (path := pictures / picture_name(attempt, view)).exists()
    )
    lifted = (
        f"lifted {', '.join(attempt.grasped)}" if attempt.grasped else f"on the table: {', '.join(attempt.objects)}"
    )
    return (
        '<div class="attempt"><header>'
        f'<span class="badge" style="background:{OUTCOMES[attempt.outcome].colour}">{escape(attempt.outcome)}</span>'
        f"<b>Round {attempt.round}, attempt {attempt.attempt}</b><span>score {attempt.score:.3f}</span>"
        f'<small>{escape(lifted)}</small></header><div class="views">{figures}</div></div>'
    )


def _encoded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")


def _table(rows: Iterable[tuple[str, Any]]) -> str:
    cells = "".join(f"<tr><th>{escape(str(name))}</th><td>{escape(str(value))}</td></tr>" for name, value in rows)
    return f'<div class="table"><table>{cells}</table></div>'


def _words(name: str) -> str:
    return name.replace("_", " ")


def _setting(name: str, value: Any) -> str:
    if value is None:
        return _UNSET.get(name, "none")
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
