"""report.html: a run on one page that needs nothing beside it; pictures and drawings are inlined."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from simharness.metrics import Rate, Summary, summarise
from simharness.photographer import VIEWS, picture_name
from simharness.records import AttemptRecord
from simharness.report import percent, times, title
from simharness.run import Run

_OUTCOME_COLOURS = {
    "success": "#16a34a",
    "pregrasp": "#7c3aed",
    "approach": "#d97706",
    "slip": "#dc2626",
    "drop": "#db2777",
}
_END_COLOURS = {"empty": "#16a34a", "two_failures": "#dc2626", "no_grasps": "#64748b"}
_OUTCOME_MEANINGS = {
    "success": "lifted and held",
    "pregrasp": "contact where the hand appeared",
    "approach": "contact on the way",
    "slip": "nothing held after closing",
    "drop": "lost while lifting",
}
_VIEW_TITLES = {
    "colour": "Camera, colour",
    "segmentation": "Camera, segmentation",
    "cloud": "Cloud with the executed grasp",
}


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
        f'<p class="subtitle">{escape(title(run))}</p>',
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
        _table((name.replace("_", " "), _plain(value)) for name, value in content["settings"].items()),
        "<h2>Model and packages</h2>",
        _table([*(content["model"] or {}).items(), *content["versions"].items()]),
    ]
    body = "\n".join(section for section in sections if section)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title(run))}</title>\n<style>{_style()}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _style() -> str:
    return (resources.files("simharness") / "page.css").read_text(encoding="utf-8")


def _warning(run: Run) -> str:
    planned = run.settings.rounds * len(run.settings.seeds)
    return (
        f'<p class="warning"><b>Incomplete: {len(run.rounds)} of {planned} rounds.</b> '
        f"{escape(run.stopped_by or '')}</p>"
    )


def _rate_card(name: str, rate: Rate, what: str) -> str:
    low, high = rate.interval
    return (
        f'<div class="card"><h3>{escape(name)}</h3><div class="value">{percent(rate)}</div>{_interval(rate)}'
        f'<div class="note">{rate.count} of {rate.total} {escape(what)}; 95 % Wilson interval '
        f"{100 * low:.1f} to {100 * high:.1f} %</div></div>"
    )


def _interval(rate: Rate) -> str:
    """A bar from 0 to 100 % with the interval and the rate."""
    low, high = (100 * limit for limit in rate.interval)
    ticks = "".join(
        f'<line x1="{4 + 3.92 * at}" y1="20" x2="{4 + 3.92 * at}" y2="24" stroke="#94a3b8"/>'
        f'<text x="{4 + 3.92 * at}" y="36" font-size="10" fill="#64748b" text-anchor="{anchor}">{at}</text>'
        for at, anchor in ((0, "start"), (25, "middle"), (50, "middle"), (75, "middle"), (100, "end"))
    )
    dot = (
        ""
        if rate.value is None
        else f'<circle cx="{4 + 392 * rate.value:.2f}" cy="11" r="6" fill="#2563eb" stroke="#fff" stroke-width="2"/>'
    )
    return (
        '<svg viewBox="0 0 400 40" role="img" aria-label="rate with interval">'
        '<rect x="4" y="7" width="392" height="8" rx="4" fill="#e2e8f0"/>'
        f'<rect x="{4 + 3.92 * low:.2f}" y="7" width="{3.92 * (high - low):.2f}" height="8" rx="4" fill="#93c5fd"/>'
        f"{dot}{ticks}</svg>"
    )


def _stack(parts: Sequence[tuple[int, str]]) -> str:
    """A bar divided in proportion to counts."""
    total = sum(count for count, _ in parts)
    pieces, at = [], 0.0
    for count, colour in parts:
        if count:
            width = 400 * count / total
            pieces.append(
                f'<rect x="{at:.2f}" y="0" width="{max(width - 1.5, 0.5):.2f}" height="18" rx="3" fill="{colour}"/>'
            )
            at += width
    empty = '<rect x="0" y="0" width="400" height="18" rx="3" fill="#e2e8f0"/>' if not total else ""
    return f'<svg viewBox="0 0 400 18" role="img" aria-label="shares">{empty}{"".join(pieces)}</svg>'


def _legend(entries: Iterable[tuple[str, int, str, str]]) -> str:
    items = "".join(
        f'<li><i style="background:{colour}"></i>{escape(name.replace("_", " "))} <b>{count}</b> '
        f"<span>{escape(note)}</span></li>"
        for name, count, colour, note in entries
    )
    return f'<ul class="legend">{items}</ul>'


def _outcomes(summary: Summary) -> str:
    outcomes = {"success": summary.gsr.count, **summary.failures}
    entries = [(kind, count, _OUTCOME_COLOURS[kind], _OUTCOME_MEANINGS[kind]) for kind, count in outcomes.items()]
    return (
        '<div class="card"><h3>Attempts by outcome</h3>'
        f"{_stack([(count, colour) for _, count, colour, _ in entries])}{_legend(entries)}</div>"
    )


def _ends(summary: Summary) -> str:
    entries = [(way, count, _END_COLOURS[way], "") for way, count in summary.ended.items()]
    nothing = ", ".join(f"{escape(reason)} {count}" for reason, count in summary.no_grasps.items()) or "none"
    return (
        f'<div class="card"><h3>Rounds by end</h3>{_stack([(count, colour) for _, count, colour, _ in entries])}'
        f'{_legend(entries)}<div class="note">Observations without a grasp: {nothing}</div></div>'
    )


def _latencies(summary: Summary) -> str:
    return (
        f'<div class="card"><h3>Latency of a request, median</h3><div class="value">{escape(_median(summary))}</div>'
        f'<div class="note">inside the service {times(summary.service_ms)}<br>'
        f"round trip {times(summary.round_trip_ms)}</div></div>"
    )


def _median(summary: Summary) -> str:
    median = summary.service_ms.median
    return "-" if median is None else f"{median:.0f} ms"


def _seeds(run: Run) -> str:
    if len(run.settings.seeds) < 2:
        return ""
    rows = ["<tr><th>seed</th><th>GSR</th><th>DR</th></tr>"]
    for seed in run.settings.seeds:
        summary = summarise(record for record in run.rounds if record.seed == seed)
        cells = "".join(
            f"<td>{percent(rate)} ({rate.count} of {rate.total})</td>" for rate in (summary.gsr, summary.dr)
        )
        rows.append(f"<tr><td>{seed}</td>{cells}</tr>")
    return f'<h2>By seed</h2><div class="table"><table>{"".join(rows)}</table></div>'


def _attempts(shown: Sequence[AttemptRecord], pictures: Path) -> str:
    cards = [_attempt(attempt, pictures) for attempt in shown]
    return "\n".join(["<h2>Attempts</h2>", *cards]) if cards else ""


def _attempt(attempt: AttemptRecord, pictures: Path) -> str:
    figures = "".join(
        f'<figure><img alt="{_VIEW_TITLES[view]}" loading="lazy" src="data:image/png;base64,{_encoded(path)}">'
        f"<figcaption>{_VIEW_TITLES[view]}</figcaption></figure>"
        for view in VIEWS
        if (path := pictures / picture_name(attempt, view)).exists()
    )
    lifted = f"lifted {', '.join(attempt.grasped)}" if attempt.grasped else f"of {', '.join(attempt.objects)}"
    return (
        '<div class="attempt"><header>'
        f'<span class="badge" style="background:{_OUTCOME_COLOURS[attempt.outcome]}">{escape(attempt.outcome)}</span>'
        f"<b>Round {attempt.round}, attempt {attempt.attempt}</b><span>score {attempt.score:.3f}</span>"
        f'<small>{escape(lifted)}</small></header><div class="views">{figures}</div></div>'
    )


def _encoded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")


def _table(rows: Iterable[tuple[str, Any]]) -> str:
    cells = "".join(f"<tr><th>{escape(str(name))}</th><td>{escape(str(value))}</td></tr>" for name, value in rows)
    return f'<div class="table"><table>{cells}</table></div>'


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return "default" if value is None else str(value)
