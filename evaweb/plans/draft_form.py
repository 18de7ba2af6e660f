"""Form of a draft: typed text to values, with a message for each invalid field."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from django import forms
from django.contrib.auth.models import User
from django.http import QueryDict

from evaweb.core.errors import EvaError
from evaweb.plans.design import look_schedule
from evaweb.plans.drafting import HIDDEN, Values
from evaweb.plans.models import Comparing, Plan, Position
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint

_POINTS = 100


def read(
    given: QueryDict, *, hidden: Collection[int], unseen: int, owners: bool
) -> tuple[Values, dict[str, str]]:
    """Return the values of the valid fields, and messages for the invalid ones by name.

    Args:
        given: The posted form.
        hidden: Ids of checkpoints that the user may not choose, because they are hidden.
        unseen: Number of hidden checkpoints that the draft has.
        owners: Whether the form has a field for the owner.
    """
    form = _Draft(given)
    form.unseen = unseen
    form.fields["checkpoints"].queryset = Checkpoint.objects.exclude(pk__in=hidden)  # type: ignore[attr-defined]
    if not owners:
        del form.fields["owner"]
    form.is_valid()
    faults = {str(name): _sentence(name, messages[0], given) for name, messages in form.errors.items()}
    return {name: _plain(value) for name, value in form.cleaned_data.items() if name != "kind"}, faults


def _sentence(name: str, message: Any, query: QueryDict) -> str:
    typed = query.get(name, "").strip()
    return f"{typed!r:.40} is not saved. {message}" if typed else f"Not saved. {message}"


def _plain(value: Any) -> Any:
    if isinstance(value, User):
        return value.pk
    return sorted(row.pk for row in value) if hasattr(value, "model") else value


def _of(name: str, **more: Any) -> Any:
    """Return the form field that Django derives from the model's field `name`."""
    field: Any = Plan._meta.get_field(name)
    return field.formfield(validators=field.validators, **more)


def _several(rows: Any) -> forms.ModelMultipleChoiceField:
    return forms.ModelMultipleChoiceField(rows, required=False)


def _is_number(word: str) -> bool:
    return word.isascii() and word.isdecimal() and len(word) < 10


class _Draft(forms.Form):
    unseen = 0
    title = _of("title")
    question = _of("question")
    owner = _of("owner")
    kind = forms.ChoiceField(choices=(("difference", "difference"), ("margin", "margin")))
    margin = forms.FloatField(required=False, min_value=0.1, max_value=99.9)
    outcome = _of("outcome")
    checkpoints = _several(Checkpoint.objects.all())
    control = forms.CharField(required=False)
    challenger = forms.CharField(required=False)
    comparing = _of("comparing")
    positions = _several(Position.objects.all())
    stations = _several(Station.objects.all())
    stopping = _of("stopping")
    repetitions = _of("repetitions")
    alpha = _of("alpha")
    look_after = forms.CharField(required=False)
    drop_arms = _of("drop_arms")
    allocation = _of("allocation")
    blind = _of("blind")
    second_rater_share = forms.FloatField(min_value=0, max_value=100)
    match_gate = _of("match_gate")
    on_estop = _of("on_estop")
    on_interruption = _of("on_interruption")
    on_timeout = _of("on_timeout")

    def clean_question(self) -> str:
        """Normalize line ends to those of plan files."""
        return str(self.cleaned_data["question"]).replace("\r\n", "\n")

    def clean_second_rater_share(self) -> float:
        """Convert percent to a fraction."""
        return round(float(self.cleaned_data["second_rater_share"]) / _POINTS, 6)

    def clean_margin(self) -> float | None:
        """Convert percentage points to a fraction; None if the plan asks whether two checkpoints differ."""
        points = self.cleaned_data["margin"]
        if self.cleaned_data.get("kind") != "margin":
            return None
        if points is None:
            raise forms.ValidationError("Say by how many points it may be worse: 0.1 to 99.9.")
        return round(float(points) / _POINTS, 6)

    def clean_look_after(self) -> list[int]:
        """Return comma-separated integers; [] for a look after every pair."""
        numbers = self.cleaned_data["look_after"].replace(",", " ").split()
        try:
            return look_schedule([int(word) if _is_number(word) else word for word in numbers])
        except EvaError:
            raise forms.ValidationError("Allowed: rising numbers of pairs, such as 20, 40, 60.") from None

    def clean(self) -> dict[str, Any]:
        """Clear control and challenger unless they are checkpoints of the plan that its comparisons name."""
        values = self.cleaned_data
        named = {Comparing.ALL: (), Comparing.CONTROL: ("control",)}.get(
            values.get("comparing"), ("control", "challenger")
        )
        chosen = {str(row.pk) for row in values.get("checkpoints", ())} | {HIDDEN}
        for name in ("control", "challenger"):
            if values.get(name) not in chosen or name not in named:
                values[name] = ""
        if values.get("challenger") == values.get("control") or len(chosen) - 1 + self.unseen == 2:
            values["challenger"] = ""  # with two checkpoints the challenger is implied
        return values
