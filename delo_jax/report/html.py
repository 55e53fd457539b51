"""The page of a run: one HTML file that needs nothing beside it."""

import dataclasses
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np

from delo_jax.report.cloud import PlacedCloud
from delo_jax.report.page_data import STATUSES, Frames, Refined, encode

TEMPLATES = Path(__file__).parent
MARKS = dict(zip(STATUSES, "●▲◆✕", strict=True))
MAX_ROWS = 200
"""Of the table of frames that are not ok."""


class Card(NamedTuple):
    """One number of a run, with what it means."""

    label: str
    value: str
    unit: str = ""
    note: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Everything that a page shows; texts are plain and escaped when they are put in."""

    title: str
    subtitle: str
    """Data, sensor, number of scans, length and duration."""
    verdict: str
    """How it went, in one line."""
    cards: Sequence[Card]
    notes: Sequence[str]
    """Sentences that a reader should know, such as what is left out."""
    frames: Frames
    cloud: PlacedCloud
    truth: np.ndarray | None
    """(n, 4, 4) of the same frames; None where unknown."""
    refined: Refined | None
    making: Sequence[tuple[str, str]]
    """How it was made: names and values."""
    config: str
    """The run's config.toml."""


def render(report: Report) -> str:
    """The page as text. It loads nothing: styles, script, numbers and map stand in it."""
    parts = {
        "title": escape(report.title),
        "subtitle": escape(report.subtitle),
        "verdict": escape(report.verdict),
        "cards": "\n".join(map(_card, report.cards)),
        "notes": "\n".join(f"<p class=note>{escape(note)}</p>" for note in report.notes),
        "statuses": _statuses(report.frames.statuses),
        "frames": _table(report.frames),
        "making": "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in report.making),
        "config": escape(report.config),
        "summary": escape(_in_words(report)),
        "last": str(max(len(report.frames.statuses) - 1, 0)),
        "style": _template("page.css"),
        "script": _template("page_map.js") + _template("page_charts.js"),
        "data": encode(report.frames, report.cloud, truth=report.truth, refined=report.refined),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _template("page.html"))  # one pass: values may hold braces


def _template(name: str) -> str:
    return (TEMPLATES / name).read_text(encoding="utf-8")


def _card(card: Card) -> str:
    unit = f" <small>{escape(card.unit)}</small>" if card.unit else ""
    note = f"<p>{escape(card.note)}</p>" if card.note else ""
    return f"<li><h3>{escape(card.label)}</h3><strong>{escape(card.value)}{unit}</strong>{note}</li>"


def _statuses(statuses: Sequence[str]) -> str:
    """A bar that is shared as the statuses are, and what each part is."""
    counts = [(name, sum(status == name for status in statuses)) for name in STATUSES]
    seen = [(name, count) for name, count in counts if count]
    bars = "".join(f'<i class="{name}" style="flex-grow:{count}"></i>' for name, count in seen)
    words = "".join(f'<li><b class="{name}">{MARKS[name]}</b> {count} {name.replace("_", " ")}</li>' for name, count in seen)
    return f"<div class=shares aria-hidden=true>{bars}</div><ul class=shares-words>{words}</ul>"


def _table(frames: Frames) -> str:
    """Rows of the frames that are not ok, each with a link to the map."""
    numbers = [number for number, status in enumerate(frames.statuses) if status != "ok"]
    if not numbers:
        return "<p>None: every frame is ok.</p>"
    rows = []
    for number in numbers[:MAX_ROWS]:
        status = frames.statuses[number]
        seconds = 1e-9 * float(frames.stamps_ns[number] - frames.stamps_ns[0])
        mark = f'<b class="{status}">{MARKS[status]}</b> {status.replace("_", " ")}'
        link = f'<a href="#map" data-frame="{number}">{number}</a>'
        rows.append(f"<tr><td>{link}<td>{seconds:.2f}<td>{mark}<td>{escape(frames.reasons[number])}")
    more = len(numbers) - MAX_ROWS
    rest = f"<p>and {more} more; frames.csv has them all</p>" if more > 0 else ""
    head = "<thead><tr><th scope=col>frame<th scope=col>time [s]<th scope=col>status<th scope=col>reason</thead>"
    table = f"<table>{head}<tbody>{''.join(rows)}</table>"
    return f'<div class=wide tabindex=0 role=region aria-label="Frames that are not ok">{table}</div>{rest}'


def _in_words(report: Report) -> str:
    """What the map shows, for those who do not see it."""
    with_it = ["the estimated track"]
    with_it += ["the true one"] if report.truth is not None else []
    with_it += ["the refined one"] if report.refined is not None else []
    return f"Seen from above: {', '.join(with_it)}, over {len(report.cloud.points)} points of the map. {report.verdict}"
