"""Citation of a result: one sentence, table and figure with the design, as text, LaTeX and SVG."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from django.urls import reverse

from evaweb.core.errors import Conflict
from evaweb.plans.counting import ENDS
from evaweb.plans.design import (
    arms_of,
    blocks_of_record,
    compared,
    counted_now,
    frozen_design,
    reveal_record,
    same_blocks,
)
from evaweb.plans.models import Plan, PlanState
from evaweb.results.analysis.wording import format_interval, rate_words
from evaweb.results.presentation.drawings import rates
from evaweb.results.presentation.drawings.svg import Drawing, printable
from evaweb.results.presentation.headline import alpha_text, letters_of, rule_text, sentence_of
from evaweb.results.presentation.latex import escaped, foreign
from evaweb.results.presentation.setting import setting_now
from evaweb.statistics.designs import ANYTIME, FIXED, SUCCESS, Block, Design, look_schedule
from evaweb.statistics.proportions import Proportion, proportion
from runtime.core.sentences import Pattern

_HAS_NO_COMPARISON_THERE_NO = Pattern(
    "results.presentation.citing.has_no_comparison_there_no",
    "{plan} has no comparison: there is no one sentence to cite; its report has all figures",
)
_RESULT_CITED_ONCE_PLAN_CLOSED = Pattern(
    "results.presentation.citing.result_cited_once_plan_closed",
    "{plan} is {state}: a result is cited once the plan is closed",
)

HEAD = ("Checkpoint", "n", "Successes", "Rate, 95 % Wilson", "Mean score")
_AXIS = 40  # [characters] of the axis in text
_NAMES_MM, _AXIS_MM, _STEP_MM = 45, 60, 6


@dataclass(frozen=True, slots=True)
class CitedRow:
    """Row of the table; `success` and `score` (0 to 1) are None if the reveal did not record them."""

    checkpoint: str
    n: int
    success: Proportion | None
    score: float | None

    @property
    def cells(self) -> tuple[str, ...]:
        """Name, n, successes, rate with interval, and mean score, as text."""
        success = self.success
        rate = "not kept"
        if success is not None:
            rate = (
                f"{100 * success.rate:.0f} % [{format_interval(success.interval)}]"
                if success.rate is not None and success.interval
                else "–"
            )
        return (
            self.checkpoint,
            str(self.n),
            "not kept" if success is None else str(success.successes),
            rate,
            "–" if self.score is None else f"{self.score:.2f}",
        )


@dataclass(frozen=True)
class Citation:
    """Result of a plan for citing.

    If the plan was revealed, `kept` is the record of its reveal, and `digest` the digest of that record. Otherwise
    `kept` describes the current state, and `digest` is "".
    """

    plan: Plan
    found: Design
    kept: Mapping[str, Any]
    digest: str

    @property
    def address(self) -> str:
        """Path of the citation's page, permanent after a reveal.

        It has no host, because a lab may have several names.
        """
        if self.digest:
            return reverse("result-frozen", args=[self.digest])
        return reverse("result-cite", args=[self.plan.name, self.plan.version])

    @property
    def commitment(self) -> str:
        """Commitment as the reveal recorded it; if it is not recorded there, the commitment of the plan."""
        return str(self.kept.get("commitment") or self.plan.commitment)

    @property
    def key(self) -> str:
        """Key of the commitment in hex; "" before the reveal."""
        own = bytes(self.plan.key or b"").hex()
        return str(self.kept.get("key") or own) if self.digest else ""

    @property
    def revealed_by(self) -> str:
        """Name of the account that revealed the plan, as it was at the reveal."""
        own = self.plan.revealed_by.get_username() if self.plan.revealed_by else ""
        return str(self.kept.get("by") or own)

    @cached_property
    def sentence(self) -> str:
        """Headline, with the groups of checkpoints that share a letter."""
        letters = letters_of(self.plan, self.found, self.blocks)
        letter_list = ", ".join(f"{name} {of}" for name, of in letters)
        letters_text = (
            f" No significant difference between checkpoints that share a letter: {letter_list}."
            if letter_list
            else ""
        )
        return sentence_of(self.plan, self.found, self.blocks) + "." + letters_text

    @cached_property
    def blocks(self) -> list[Block]:
        """Blocks of trials from which the conclusion is drawn."""
        return blocks_of_record(self.kept)

    @cached_property
    def design(self) -> str:
        """Design as planned: rule, looks, pairs, alpha, question, outcome."""
        document = self.plan.document or {}
        design = self.found
        asks = " and ".join(_question(design, *names) for names in compared(document))
        outcome = "success" if design.outcome == SUCCESS else "score (partial credit)"
        blind = "operators blind" if document["blind"] else "operators not blind"
        drops = "; checkpoints dropped once they were found worse" if design.drops else ""
        order = "" if design.counts is None else ", checkpoints in random order"
        return (
            f"Design: {rule_text(self.plan)}, {_looks(design)}, {design.blocks} {design.unit} foreseen{order}, "
            f"{alpha_text(design)}; asks {asks}, by {outcome}{drops}; {blind}{_declared(document)}."
        )

    @cached_property
    def setting(self) -> str:
        """Robot, scenes, dates and scorers; "" for a reveal that did not record them."""
        text = str(self.kept.get("setting", "")) if self.digest else setting_now(self.plan)
        return f"{text}." if text else ""

    @cached_property
    def source(self) -> str:
        """Source: plan, version, digests, address."""
        document = self.plan.document or {}
        plan_text = f"EVA Web, plan {document['name']} v{document['version']}, plan digest {self.plan.digest}"
        where = (
            f", as {'revealed' if self.plan.blind else 'closed'} {self.kept['at'][:10]}, digest {self.digest}"
            if self.digest
            else ", not revealed"
        )
        return f"{plan_text}{where}: {self.address}"

    @property
    def caveats(self) -> list[str]:
        """Reasons for doubt as recorded at the reveal; [] for a reveal that did not record them."""
        return list(self.kept.get("caveats", ()))

    @property
    def doubts(self) -> list[str]:
        """Reasons for doubt as lines of text."""
        return [f"Reason for doubt: {caveat}." for caveat in self.caveats]

    @property
    def lines(self) -> list[str]:
        """Lines of the citation: sentence, setting, design, reasons for doubt and source, as far as there are any."""
        return [
            line for line in (self.sentence, self.setting, self.design, *self.doubts, self.source) if line
        ]

    @cached_property
    def rows(self) -> list[CitedRow]:
        """Rows of the table, in the order of the frozen plan."""
        if "arms" in self.kept:
            return [
                CitedRow(row["checkpoint"], row["n"], proportion(row["successes"], row["n"]), row["score"])
                for row in self.kept["arms"]
            ]
        return [self._of_pairs(i, name) for i, name in enumerate(arms_of(compared(self.plan.document or {})))]

    def _of_pairs(self, i: int, name: str) -> CitedRow:
        """Return the table's row of checkpoint `name`, computed from the blocks of trials in which it is arm `i`.

        This is for a plan whose reveal recorded only the pairs, and not the values of the rows.
        """
        values = [value for block in self.blocks for arm, value in block if arm == i]
        n = len(values)
        if self.found.outcome != SUCCESS:
            return CitedRow(name, n, None, sum(values) / n if n else None)
        return CitedRow(name, n, proportion(int(sum(values)), n), None)

    @cached_property
    def known(self) -> list[tuple[str, Proportion]]:
        """Name and success of each checkpoint with a recorded success: the rows of the figure."""
        return [(row.checkpoint, row.success) for row in self.rows if row.success is not None]

    @property
    def corrected(self) -> bool:
        """Whether scores were corrected or added after the reveal."""
        now = counted_now(self.plan)
        arms = self.kept.get("arms", now["arms"])
        return not same_blocks(blocks_of_record(now), self.blocks) or now["arms"] != arms

    @cached_property
    def text(self) -> dict[str, str]:
        """Sentence, table and figure as plain text."""
        return {
            "sentence": "\n".join(self.lines) + "\n",
            "table": _text_table([row.cells for row in self.rows]),
            "figure": _text_figure(self.known),
        }

    @cached_property
    def latex(self) -> dict[str, str]:
        """Sentence, table and figure as LaTeX that needs no package."""
        rows = [row.cells for row in self.rows]
        sentence = "\n".join(map(escaped, self.lines)) + "\n"
        return {"sentence": sentence, "table": _latex_table(rows), "figure": _latex_figure(self.known)}

    @cached_property
    def figure_html(self) -> Drawing:
        """Figure for a page."""
        names = [row["name"] for row in (self.plan.document or {})["checkpoints"]]
        order = {name: i for i, name in enumerate(names)}
        return rates.draw_intervals("Success rates", [(name, rate, "") for name, rate in self.known], order)

    @cached_property
    def svg(self) -> str:
        """Standalone figure with sentence, design and source, black on white."""
        return printable(self.figure_html, above=[self.sentence], below=self.lines[1:])

    def render(self, form: str) -> str:
        """Return the complete citation as a file: "txt", "tex" or "svg"."""
        if form == "svg":
            return '<?xml version="1.0" encoding="UTF-8"?>\n' + self.svg
        if form == "txt":
            return "\n".join(self.text.values())
        strange = foreign("".join(cell for row in self.rows for cell in row.cells) + self.sentence)
        note = f"% pdfLaTeX does not print {' '.join(strange)}: use LuaLaTeX or XeLaTeX\n" if strange else ""
        return note + "\n".join(self.latex.values())

    @property
    def document(self) -> dict[str, Any]:
        """Complete citation as JSON."""
        document = self.plan.document or {}
        return {
            "plan": document["name"],
            "version": document["version"],
            "title": document["title"],
            "digest": self.digest,
            "plan_digest": self.plan.digest,
            "commitment": self.commitment,
            "key": self.key,
            "revealed_at": self.kept["at"],
            "revealed_by": self.revealed_by,
            "comparisons": [list(names) for names in compared(document)],
            "design": {
                "rule": self.found.rule,
                "pairs": self.found.blocks,
                "drops": self.found.drops,
                "counts": self.found.counts,
                "alpha": self.found.alpha,
                "outcome": self.found.outcome,
                "margin": self.found.margin,
                "looks": look_schedule(self.found),
                "words": self.design,
            },
            "blocks": self.blocks,
            "headline": self.sentence,
            "setting": self.setting,
            "caveats": self.caveats,
            "arms": [
                {
                    "checkpoint": row.checkpoint,
                    "n": row.n,
                    "successes": row.success.successes if row.success else None,
                    "rate": row.success.rate if row.success else None,
                    "wilson": [row.success.interval.low, row.success.interval.high]
                    if row.success and row.success.interval
                    else None,
                    "score": row.score,
                }
                for row in self.rows
            ],
            "address": self.address,
            "text": self.text,
            "latex": self.latex,
            "svg": self.svg,
        }


def citation(plan: Plan) -> Citation:
    """Return the citation of a plan: as recorded if revealed, as of now if closed.

    Raises:
        Conflict: If trials are still being made, or no comparison was planned.
    """
    design = frozen_design(plan.document) if plan.document else None
    if design is None:
        raise Conflict(_HAS_NO_COMPARISON_THERE_NO(plan=plan))
    if plan.state not in (PlanState.CLOSED, PlanState.REVEALED):
        raise Conflict(_RESULT_CITED_ONCE_PLAN_CLOSED(plan=plan, state=plan.get_state_display()))
    reveal = plan.at_reveal or reveal_record(plan) or {}
    return Citation(plan, design, reveal, plan.at_reveal["digest"] if plan.at_reveal else "")


def _declared(document: Mapping[str, Any]) -> str:
    """Return the plan's rules on runs with an abnormal end as text: what each kind of end counts as."""
    counts = {"failure": "a failure", "repeated": "no trial, and is repeated"}
    counts_as = document.get("counts_as", {})
    return "".join(
        f"; {ENDS[name]} makes {counts[counts_as[name]]}" for name in ENDS if counts_as.get(name) in counts
    )


def _question(design: Design, first: str, second: str) -> str:
    if design.margin is not None:
        return f"whether {first} is not worse than {second} by {100 * design.margin:g} points or more"
    return f"whether {first} and {second} differ"


def _looks(design: Design) -> str:
    if design.rule == FIXED:
        return "one test at the end"
    at = look_schedule(design)
    if design.rule == ANYTIME or at == list(range(1, design.blocks + 1)):
        return f"looked at after every {design.unit[:-1]}"
    return f"looked at after {', '.join(map(str, at))} {design.unit}"


def _text_table(rows: list[tuple[str, ...]]) -> str:
    widths = [max(len(row[i]) for row in (HEAD, *rows)) for i in range(len(HEAD))]
    lines = [
        "  ".join(cell.ljust(wide) for cell, wide in zip(row, widths, strict=True)).rstrip()
        for row in (HEAD, tuple("-" * wide for wide in widths), *rows)
    ]
    return "\n".join(lines) + "\n"


def _text_figure(rows: list[tuple[str, Proportion]]) -> str:
    wide = max((len(name) for name, _ in rows), default=0)
    lines = []
    for name, rate in rows:
        axis = [" "] * (_AXIS + 1)
        if rate.rate is not None and rate.interval is not None:
            low, high = round(rate.interval.low * _AXIS), round(rate.interval.high * _AXIS)
            axis[low : high + 1] = "-" * (high + 1 - low)
            axis[round(rate.rate * _AXIS)] = "o"
        lines.append(f"{name.ljust(wide)}  |{''.join(axis)}|  {rate_words(rate)}")
    lines.append(f"{' ' * wide}   0 %{'100 %'.rjust(_AXIS - 2)}")
    return "\n".join(lines) + "\n"


def _latex_table(rows: list[tuple[str, ...]]) -> str:
    def said(row: tuple[str, ...]) -> str:
        return "  {}" + " & ".join(escaped(cell) for cell in row) + r" \\"  # {}: a name may begin with [ or *

    lines = [r"\begin{tabular}{lrrlr}", r"  \hline", said(HEAD), r"  \hline", *map(said, rows), r"  \hline"]
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def _latex_figure(rows: list[tuple[str, Proportion]]) -> str:
    """Return the figure as a LaTeX picture environment, in mm."""
    high = _STEP_MM * (len(rows) + 1)
    lines = [
        r"\begingroup\setlength{\unitlength}{1mm}%",
        rf"\begin{{picture}}({_NAMES_MM + _AXIS_MM + 40},{high})",
        rf"  \put({_NAMES_MM},{_STEP_MM}){{\line(1,0){{{_AXIS_MM}}}}}",
    ]
    for percent in (0, 25, 50, 75, 100):
        x = _NAMES_MM + _AXIS_MM * percent / 100
        lines.append(rf"  \put({x:g},{_STEP_MM}){{\line(0,-1){{1}}}}")
        lines.append(rf"  \put({x:g},2){{\makebox(0,0){{\footnotesize {percent}\,\%}}}}")
    for i, (name, rate) in enumerate(rows):
        y = high - _STEP_MM * i - _STEP_MM / 2
        lines.append(rf"  \put({_NAMES_MM - 3},{y:g}){{\makebox(0,0)[r]{{{escaped(name)}}}}}")
        if rate.rate is not None and rate.interval is not None:
            low, wide = rate.interval.low * _AXIS_MM, (rate.interval.high - rate.interval.low) * _AXIS_MM
            lines.append(rf"  \put({_NAMES_MM + low:.2f},{y:g}){{\line(1,0){{{wide:.2f}}}}}")
            lines.append(rf"  \put({_NAMES_MM + rate.rate * _AXIS_MM:.2f},{y:g}){{\circle*{{1.6}}}}")
        label = escaped(rate_words(rate))
        lines.append(
            rf"  \put({_NAMES_MM + _AXIS_MM + 3},{y:g}){{\makebox(0,0)[l]{{\footnotesize {label}}}}}"
        )
    return "\n".join([*lines, r"\end{picture}\endgroup"]) + "\n"
