"""Admin pages of scenes and checkpoints; evaluations, trials and scores are read-only records."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any
from urllib.parse import urlsplit

from django import forms
from django.contrib import admin, messages
from django.core.exceptions import ValidationError
from django.db import models
from django.db.models import Count, Q, QuerySet
from django.forms.fields import InvalidJSONInput
from django.forms.models import model_to_dict
from django.http import HttpRequest
from django.urls import reverse
from django.utils.html import format_html

from evaweb.accounts.admin_site import LabelledRows
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.canonical_json import difference
from evaweb.trials.models import (
    Checkpoint,
    Evaluation,
    FailureTerm,
    Milestone,
    MilestoneOutcome,
    Position,
    Scene,
    Score,
    Trial,
)
from evaweb.trials.scene_reading import scene_table
from evaweb.trials.selectors import checkpoint_used
from evaweb.trials.tables import check_milestones
from runtime.core import bounded_documents as bounded

LONGEST_TABLE = 64 * 1024  # characters; the limit of a station
_SHORT = {models.TextField: {"widget": forms.Textarea(attrs={"rows": 2, "cols": 80})}}


class Table(forms.JSONField):
    """JSON form field that reports where the text is invalid; used for every JSON field to bound size and depth."""

    widget = forms.Textarea(attrs={"rows": 3, "cols": 60, "spellcheck": "false", "class": "mono"})

    def to_python(self, value: Any) -> Any:
        """Return the parsed value. Raises: ValidationError with line and column, or with the exceeded limit."""
        if isinstance(value, str) and value.strip():
            try:
                self._read(value)
            except bounded.UnreadableDocument as error:
                raise ValidationError(
                    f'{error}. Keys and texts stand in double quotes, as in {{"url": "ws://127.0.0.1:8000"}}.'
                ) from None
        return super().to_python(value)

    def bound_data(self, data: Any, initial: Any) -> Any:
        """Return the value to display again: the text as typed if it cannot be parsed."""
        if data is None:
            return None
        try:
            return self._read(data)
        except bounded.UnreadableDocument:
            return InvalidJSONInput(data)

    def _read(self, value: str) -> Any:
        return bounded.parse_json(value, "The table", LONGEST_TABLE)


class PositionForm(forms.ModelForm):
    """Form of one initial condition."""

    bench = Table(required=False, help_text=Position._meta.get_field("bench").help_text)

    class Meta:
        model = Position
        fields = ("number", "label", "description", "bench")
        widgets = {"description": forms.Textarea(attrs={"rows": 2, "cols": 40})}


class PositionInline(admin.StackedInline):
    """Table of a scene's initial positions on its admin page."""

    model = Position
    form = PositionForm
    extra = 0
    min_num = 1
    fields = (("number", "label"), "description", "bench")

    def get_formset(self, request: HttpRequest, obj: Scene | None = None, **named: Any) -> Any:
        """Require at least one position, because a trial needs one."""
        return super().get_formset(request, obj, **{"validate_min": True, **named})


class MilestoneFormSet(forms.BaseInlineFormSet):
    """Milestones of a scene; a scene that already had duplicate texts may keep them."""

    def add_fields(self, form: forms.BaseForm, index: int | None) -> None:
        """Add labels for screen readers, which Django's table lacks."""
        super().add_fields(form, index)
        for name, field in form.fields.items():
            field.widget.attrs.setdefault("aria-label", str(field.label or name))

    def clean(self) -> None:
        """Require distinct texts if any was changed."""
        super().clean()
        rows = [form for form in self.forms if form not in self.deleted_forms]
        if any("text" in form.changed_data for form in rows):
            check_milestones([text for form in rows if (text := form.cleaned_data.get("text"))])


class MilestoneInline(admin.TabularInline):
    """Table of a scene's milestones on its admin page."""

    model = Milestone
    formset = MilestoneFormSet
    extra = 0
    fields = ("order", "text", "points", "required", "time_limit_s", "truth")


class LogsValues(admin.ModelAdmin):
    """ModelAdmin whose history has the old and new value of each change."""

    def table_of(self, row: Any) -> dict[str, Any]:
        """Return the row as plain values."""
        raise NotImplementedError

    def save_model(self, request: HttpRequest, obj: Any, form: Any, change: bool) -> None:
        """Remember the values before the change for the log entry."""
        if change:
            before = type(obj)._default_manager.get(pk=obj.pk)
            request._eva_before = self.table_of(before)  # type: ignore[attr-defined]
        super().save_model(request, obj, form, change)

    def construct_change_message(
        self, request: HttpRequest, form: Any, formsets: Any, add: bool = False
    ) -> Any:
        """Return all changed values, computed after the row and its inlines are saved."""
        before = getattr(request, "_eva_before", None)
        changes = [] if before is None else difference(before, self.table_of(form.instance))
        return "; ".join(changes) or super().construct_change_message(request, form, formsets, add)


def _readable(policy: Any) -> Any:
    """Return a policy's table without parts of URL and tunnel that may contain a secret."""
    if not isinstance(policy, dict):
        return policy
    url, tunnel = str(policy.get("url") or ""), policy.get("tunnel")
    readable = {**policy}
    if url:
        parts = urlsplit(url)
        readable["url"] = f"{parts.scheme}://{parts.hostname}:{parts.port}{parts.path}"
    if isinstance(tunnel, dict):
        readable["tunnel"] = {key: tunnel[key] for key in ("host", "port") if key in tunnel}
    return readable


class ActiveActions:
    """Mixin of a ModelAdmin with actions that activate or deactivate the selected rows."""

    actions = ("switch_on", "switch_off")

    @admin.action(description="Switch on: offer to operators")
    def switch_on(self, request: HttpRequest, rows: QuerySet[Any]) -> None:
        """Offer the rows to operators."""
        self._switch(request, rows, active=True)

    @admin.action(description="Switch off: offer no longer")
    def switch_off(self, request: HttpRequest, rows: QuerySet[Any]) -> None:
        """Stop offering the rows to operators; existing trials are unaffected."""
        self._switch(request, rows, active=False)

    def _switch(self, request: HttpRequest, rows: QuerySet[Any], active: bool) -> None:
        changed = list(rows.filter(active=not active))
        rows.update(active=active)
        for row in changed:
            self.log_change(request, row, f"active: {str(not active).lower()} -> {str(active).lower()}")  # type: ignore[attr-defined]
        messages.success(request, f"{len(changed)} switched {'on' if active else 'off'}")


def _trials(n: int) -> str:
    return "1 trial" if n == 1 else f"{n} trials"


@admin.register(Scene)
class SceneAdmin(ActiveActions, LogsValues):
    """Admin page of scenes, with their positions and milestones."""

    def table_of(self, row: Scene) -> dict[str, Any]:
        """Return the scene in the form of the scene editor."""
        return scene_table(Scene.objects.get(pk=row.pk))

    list_display = ("title", "name", "active", "instruction", "positions_n", "milestones_n", "trials_n")
    list_filter = ("active",)
    search_fields = ("title", "name", "instruction")
    prepopulated_fields = {"name": ("title",)}
    inlines = (PositionInline, MilestoneInline)
    save_on_top = True
    formfield_overrides = _SHORT
    fieldsets = (
        (None, {"fields": (("title", "name"), "instruction", "active")}),
        (
            "At the bench",
            {"fields": ("layout", "bench", "criterion", "time_limit_s", "ordered", "failure_required")},
        ),
    )

    def get_queryset(self, request: HttpRequest) -> QuerySet[Scene]:
        """Add the numbers of positions, milestones and trials."""
        return (
            super()
            .get_queryset(request)
            .annotate(
                n_positions=Count("positions", distinct=True),
                n_milestones=Count("milestones", distinct=True),
                n_trials=Count("trials", distinct=True),
            )
        )

    def get_readonly_fields(self, request: HttpRequest, obj: Scene | None = None) -> tuple[str, ...]:
        """Fix the name of an existing scene, which is part of seeds and exports."""
        return ("name",) if obj else ()

    def get_prepopulated_fields(self, request: HttpRequest, obj: Scene | None = None) -> dict[str, Any]:
        """Derive the name from the title only for a new scene."""
        return {} if obj else dict(self.prepopulated_fields)

    def save_formset(self, request: HttpRequest, form: Any, formset: Any, change: bool) -> None:
        """Warn about earlier trials if milestones or positions change."""
        super().save_formset(request, form, formset, change)
        changed = formset.changed_objects or formset.deleted_objects or formset.new_objects
        trials = form.instance.trials.count() if change and changed else 0
        if trials:
            name = formset.model._meta.verbose_name_plural
            messages.warning(
                request,
                f"{_trials(trials)} made before these {name} were changed keep the old ones in their scores: "
                "where trials are to be compared, make another scene instead.",
            )

    @admin.display(description="positions", ordering="n_positions")
    def positions_n(self, scene: Scene) -> int:
        """Return the number of positions."""
        return scene.n_positions  # type: ignore[attr-defined, no-any-return]

    @admin.display(description="milestones", ordering="n_milestones")
    def milestones_n(self, scene: Scene) -> int:
        """Return the number of milestones."""
        return scene.n_milestones  # type: ignore[attr-defined, no-any-return]

    @admin.display(description="trials", ordering="n_trials")
    def trials_n(self, scene: Scene) -> int:
        """Return the number of trials."""
        return scene.n_trials  # type: ignore[attr-defined, no-any-return]


@admin.register(FailureTerm)
class FailureTermAdmin(LabelledRows, ActiveActions, admin.ModelAdmin):
    """Admin page of the taxonomy of failures; scores store the words and are unaffected by changes here."""

    list_display = ("words", "level", "shortcut", "order", "active")
    list_editable = ("order",)
    list_filter = ("level", "active")

    def get_readonly_fields(self, request: HttpRequest, obj: FailureTerm | None = None) -> tuple[str, ...]:
        """Fix the level of an existing term."""
        return ("level",) if obj else ()

    def save_model(self, request: HttpRequest, obj: FailureTerm, form: Any, change: bool) -> None:
        """Warn if scores exist with the previous words."""
        before = form.initial.get("words") if "words" in form.changed_data else ""
        super().save_model(request, obj, form, change)
        field = "failure_phase" if obj.level == FailureTerm.Level.PHASE else "failure"
        scores = Score.objects.filter(**{field: before}).count() if change and before else 0
        if scores:
            messages.warning(
                request,
                f"{scores} score{'s' if scores > 1 else ''} said {before!r} and keep it: they are counted apart "
                f"from those that will say {obj.words!r}.",
            )

    @admin.display(description="key", ordering="key")
    def shortcut(self, term: FailureTerm) -> str:
        """Return the key combination that selects the term."""
        return f"Shift + {term.key.upper()}" if term.key else ""


class CheckpointForm(forms.ModelForm):
    """Form of a checkpoint: its policy, and the connection to it."""

    policy = Table(
        required=False,
        help_text=Checkpoint._meta.get_field("policy").help_text
        + ' Over SSH: {"url": "ws://127.0.0.1:8000", "tunnel": {"host": "gpu-1.lab", "user": "lab"}}, the url as seen '
        "from that host. Never a key or a password here: a key is named by its path on the station's machine.",
    )

    strategy = Table(required=False, help_text=Checkpoint._meta.get_field("strategy").help_text)

    class Meta:
        model = Checkpoint
        fields = (
            "name",
            "description",
            "digest",
            "parent",
            "recipe",
            "training_set",
            "training_run",
            "tags",
            "policy",
            "strategy",
            "anchor",
            "active",
        )

    training_run = forms.URLField(
        required=False,
        max_length=500,
        empty_value=None,
        assume_scheme="https",
        help_text=Checkpoint._meta.get_field("training_run").help_text,
    )

    tags = forms.CharField(required=False, help_text="Words, with commas between them: to find it by.")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.initial["tags"] = ", ".join(self.instance.tags)

    def clean_tags(self) -> list[str]:
        """Return the distinct tags."""
        return list(
            dict.fromkeys(word for part in self.cleaned_data["tags"].split(",") if (word := part.strip()))
        )

    def clean_policy(self) -> dict[str, Any]:
        """Return the policy's table; {} for an empty field: then everything is as in the deployment."""
        policy = self.cleaned_data["policy"]
        return {} if policy is None else policy

    def clean_strategy(self) -> Any:
        """Return the checkpoint's strategy table, or None if the field is empty.

        A checkpoint without a strategy of its own uses that of the plan or of the station.
        """
        return self.cleaned_data["strategy"] or None


@admin.register(Checkpoint)
class CheckpointAdmin(ActiveActions, LogsValues):
    """Admin page of checkpoints."""

    def table_of(self, row: Checkpoint) -> dict[str, Any]:
        """Return all fields of the form, with the policy's table reduced to what readers of results may see."""
        table = model_to_dict(row, CheckpointForm.Meta.fields)
        return {**table, "policy": _readable(table["policy"])}

    form = CheckpointForm
    save_as = True  # copy for the same weights, served in another way
    formfield_overrides = _SHORT
    list_display = ("name", "tagged", "active", "reached_at", "trials_n", "created_at")
    list_filter = ("active",)
    search_fields = ("name", "description", "digest", "recipe", "tags")
    autocomplete_fields = ("parent",)

    def get_queryset(self, request: HttpRequest) -> QuerySet[Checkpoint]:
        """Add the number of trials, 0 for checkpoints hidden from the user."""
        hidden = visibility_for_request(request).checkpoints
        count = Count("trials", filter=~Q(pk__in=hidden)) if hidden else Count("trials")
        return super().get_queryset(request).annotate(n_trials=count)

    def get_readonly_fields(self, request: HttpRequest, obj: Checkpoint | None = None) -> tuple[str, ...]:
        """Fix the name (which manifests contain) and digest of a checkpoint that trials or plans use."""
        used = obj is not None and checkpoint_used(obj)
        return ("name", *(("digest",) if obj and obj.digest else ())) if used else ()

    def has_delete_permission(self, request: HttpRequest, obj: Checkpoint | None = None) -> bool:
        """Allow deletion only of checkpoints that no trial or frozen plan uses."""
        return super().has_delete_permission(request, obj) and (obj is None or not checkpoint_used(obj))

    def get_deleted_objects(self, objs: Iterable[Checkpoint], request: HttpRequest) -> Any:
        """Return the objects to be deleted; dependants of used checkpoints are not listed, as they may be hidden."""
        used = [checkpoint for checkpoint in objs if checkpoint_used(checkpoint)]
        deleted = super().get_deleted_objects([row for row in objs if row not in used], request)
        to_delete, counts, perms_needed, protected = deleted
        texts = [
            f"Checkpoint {checkpoint}: trials, or a plan that was frozen, are of it" for checkpoint in used
        ]
        return to_delete, counts, perms_needed, [*protected, *texts]

    def save_model(self, request: HttpRequest, obj: Checkpoint, form: Any, change: bool) -> None:
        """Save the checkpoint; warn after a change of policy or strategy if trials or a frozen plan use it.

        The warning says that trials with the old and the new table would be counted together.
        """
        super().save_model(request, obj, form, change)
        if change and {"policy", "strategy"} & {*form.changed_data} and checkpoint_used(obj):
            messages.warning(
                request,
                f"Trials, or a plan that was frozen, are of checkpoint {obj} with another policy or strategy table. If "
                "this is another policy and not only another address, make another checkpoint: all would be counted "
                "together.",
            )

    @admin.display(description="tags")
    def tagged(self, checkpoint: Checkpoint) -> str:
        """Return the tags as text."""
        return ", ".join(checkpoint.tags)

    @admin.display(description="policy")
    def reached_at(self, checkpoint: Checkpoint) -> str:
        """Return the policy's address, path or kind."""
        policy = checkpoint.policy if isinstance(checkpoint.policy, dict) else {}
        place = str(policy.get("url") or policy.get("path") or policy.get("kind") or "as deployed")
        tunnel = policy.get("tunnel")
        host = tunnel.get("host") if isinstance(tunnel, dict) else None
        return f"{place} through {host}" if host else place

    @admin.display(description="trials", ordering="n_trials")
    def trials_n(self, checkpoint: Checkpoint) -> int:
        """Return the number of trials, 0 for a hidden checkpoint."""
        return checkpoint.n_trials  # type: ignore[attr-defined, no-any-return]


class ReadOnly:
    """Mixin of admin pages of read-only records."""

    def has_add_permission(self, request: HttpRequest, obj: Any = None) -> bool:
        """Return False: records cannot be added here."""
        return False

    def has_change_permission(self, request: HttpRequest, obj: Any = None) -> bool:
        """Return False: records cannot be changed."""
        return False

    def has_delete_permission(self, request: HttpRequest, obj: Any = None) -> bool:
        """Return False: records cannot be deleted."""
        return False


@admin.register(Evaluation)
class EvaluationAdmin(ReadOnly, admin.ModelAdmin):
    """Admin page of evaluations; a station's open bench is created automatically."""

    list_display = ("name", "version", "kind", "station", "created_at")
    list_filter = ("kind", "station")
    search_fields = ("name",)


class ScoreInline(ReadOnly, admin.TabularInline):
    """Table of all scores of a trial on its admin page; the last counts."""

    model = Score
    fk_name = "trial"
    extra = 0
    fields = ("scored_at", "rater", "source", "success", "score", "why", "note", "reason")
    readonly_fields = fields


@admin.register(Trial)
class TrialAdmin(ReadOnly, admin.ModelAdmin):
    """Read-only admin page of trials.

    Scoring, correcting and voiding are on a trial's result page, which asks for the reason.
    """

    list_display = (
        "id",
        "status",
        "scene",
        "position_n",
        "checkpoint",
        "number",
        "attempt",
        "station",
        "page",
    )
    list_filter = ("status", "scene", "checkpoint", "station")
    search_fields = ("uuid", "scores__note", "scores__failure", "scores__failure_phase", "operator__username")
    list_select_related = ("scene", "position", "checkpoint", "station")
    date_hierarchy = "prepared_at"
    inlines = (ScoreInline,)

    @admin.display(description="position")
    def position_n(self, trial: Trial) -> int:
        """Return the number of the position."""
        return trial.position.number

    @admin.display(description="result")
    def page(self, trial: Trial) -> str:
        """Return a link to the result page."""
        return format_html('<a href="{}">open</a>', reverse("result-trial", args=[trial.pk]))


class OutcomeInline(ReadOnly, admin.TabularInline):
    """Table of a score's milestones as they were at scoring time."""

    model = MilestoneOutcome
    extra = 0
    fields = ("order", "text", "points", "required", "reached", "at_s")
    readonly_fields = fields


@admin.register(Score)
class ScoreAdmin(ReadOnly, admin.ModelAdmin):
    """Admin page of all scores, including corrected ones."""

    list_display = ("scored_at", "trial", "rater", "source", "success", "score", "why", "reason")
    list_filter = ("success", "source", "trial__scene", "trial__checkpoint")
    search_fields = ("note", "failure", "failure_phase", "reason", "rater__username")
    list_select_related = ("trial__scene", "trial__checkpoint", "trial__position", "rater")
    date_hierarchy = "scored_at"
    inlines = (OutcomeInline,)
