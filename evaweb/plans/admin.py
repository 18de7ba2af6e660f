"""Admin pages of plans: editing of drafts; frozen plans are managed on their own pages."""

from __future__ import annotations

from itertools import groupby
from typing import Any

from django import forms
from django.contrib import admin, messages
from django.db import models
from django.db.models import QuerySet
from django.http import HttpRequest, HttpResponse
from django.shortcuts import redirect, render
from django.urls import URLPattern, path
from django.utils.html import format_html_join
from django.utils.safestring import SafeString, mark_safe

from evaweb.core.errors import EvaError
from evaweb.plans.design import look_schedule
from evaweb.plans.models import Plan, PlanEvent, PlanState, PlanTemplate, TemplateUse
from evaweb.plans.references import LARGEST, unpacked
from evaweb.plans.toml_exchange import export_archive, export_toml, import_file
from evaweb.trials.admin import ReadOnly, Table
from evaweb.trials.models import Checkpoint, Position, Scene

_FROZEN = (
    "name",
    "title",
    "question",
    "owner",
    "positions",
    "checkpoints",
    "repetitions",
    "stations",
    "strategy",
    "blind",
    "allocation",
    "stopping",
    "comparing",
    "drop_arms",
    "outcome",
    "margin",
    "look_after",
    "alpha",
    "first",
    "second",
    "second_rater_share",
    "match_gate",
    "on_estop",
    "on_interruption",
    "on_timeout",
)


class PlanForm(forms.ModelForm):
    """Form of a draft."""

    strategy = Table(required=False, help_text=Plan._meta.get_field("strategy").help_text)
    look_after = Table(required=False, help_text=Plan._meta.get_field("look_after").help_text)

    class Meta:
        model = Plan
        fields = _FROZEN

    def clean_strategy(self) -> Any:
        """Return the strategy's table; None for an empty field: then the plan has no strategy of its own."""
        return self.cleaned_data["strategy"] or None

    def clean_look_after(self) -> list[int]:
        """Return the numbers of pairs; [] for an empty field: then there is a look after every pair."""
        try:
            value = self.cleaned_data["look_after"]
            return [] if value in self.fields["look_after"].empty_values else look_schedule(value)
        except EvaError as error:
            raise forms.ValidationError(str(error)) from None


class Conditions(forms.ModelMultipleChoiceField):
    """Form field to choose positions of several scenes, each labelled by scene and position."""

    def label_from_instance(self, obj: Any) -> str:
        """Return scene and position."""
        return f"{obj.scene}, {obj}"


class EventInline(ReadOnly, admin.TabularInline):
    """Table of a plan's events on its admin page."""

    model = PlanEvent
    extra = 0
    fields = ("at", "by", "what", "text")
    readonly_fields = fields


class FileForm(forms.Form):
    """Form for the import of a file."""

    file = forms.FileField(
        help_text="TOML with scenes, checkpoints and plans, as the export writes it; or an archive (zip) of it with "
        "reference pictures."
    )

    def clean_file(self) -> tuple[str, dict[str, bytes]]:
        """Return the text and the pictures of the file."""
        upload = self.cleaned_data["file"]
        if upload.size > LARGEST:
            raise forms.ValidationError(f"{upload.size} bytes; allowed: {LARGEST}")
        try:
            return unpacked(upload.read())
        except EvaError as error:
            raise forms.ValidationError(str(error)) from None


@admin.register(Plan)
class PlanAdmin(admin.ModelAdmin):
    """Admin page of plans."""

    form = PlanForm
    list_display = ("title", "name", "version", "state", "owner", "blind", "trials", "frozen_at")
    list_filter = ("state", "blind", "owner")
    search_fields = ("name", "title", "question")
    list_select_related = ("owner",)
    filter_horizontal = ("positions", "checkpoints", "stations")
    prepopulated_fields = {"name": ("title",)}
    inlines = (EventInline,)
    actions = ("export", "export_archive")
    formfield_overrides = {models.TextField: {"widget": forms.Textarea(attrs={"rows": 3, "cols": 80})}}
    change_list_template = "plans/admin_list.html"
    fieldsets = (
        (None, {"fields": (("title", "name"), "question", "owner")}),
        ("Trials", {"fields": ("positions", "checkpoints", "repetitions", "stations", "strategy")}),
        (
            "Rules",
            {
                "fields": (
                    ("blind", "allocation"),
                    ("comparing", "first", "second"),
                    ("stopping", "alpha", "drop_arms"),
                    ("outcome", "margin", "look_after"),
                    "second_rater_share",
                    "match_gate",
                    ("on_estop", "on_interruption", "on_timeout"),
                )
            },
        ),
    )

    def formfield_for_manytomany(
        self, db_field: Any, request: HttpRequest, **kwargs: Any
    ) -> forms.ModelMultipleChoiceField | None:
        """Label positions by scene and number."""
        if db_field.name == "positions":
            kwargs |= {"form_class": Conditions, "queryset": Position.objects.select_related("scene")}
        return super().formfield_for_manytomany(db_field, request, **kwargs)

    def get_readonly_fields(self, request: HttpRequest, obj: Plan | None = None) -> tuple[str, ...]:
        """Return the read-only fields.

        In a frozen plan, all fields of the design are read-only. In the draft of a later version, only the name is,
        because all versions share it. In any other draft no field is read-only.
        """
        if obj is None:
            return ()
        frozen = tuple("conditions" if name == "positions" else name for name in _FROZEN)
        return frozen if obj.state != PlanState.DRAFT else (("name",) if obj.version > 1 else ())

    def get_fieldsets(self, request: HttpRequest, obj: Plan | None = None) -> Any:
        """Show the positions of a frozen plan as text with their scenes; a draft has the selection list."""
        if obj is None or obj.state == PlanState.DRAFT:
            return self.fieldsets
        return [
            (
                title,
                {**options, "fields": ["conditions" if f == "positions" else f for f in options["fields"]]},
            )
            for title, options in self.fieldsets
        ]

    @admin.display(description="positions")
    def conditions(self, plan: Plan) -> SafeString:
        """Return the positions, one line per scene."""
        rows = plan.positions.select_related("scene").order_by("scene__title", "number")
        scenes = groupby(rows, key=lambda position: position.scene.title)
        lines = [(scene, "; ".join(map(str, positions))) for scene, positions in scenes]
        return format_html_join(mark_safe("<br>"), "{}: {}", lines) or mark_safe("–")

    def get_prepopulated_fields(self, request: HttpRequest, obj: Plan | None = None) -> dict[str, Any]:
        """Derive the name from the title only for a new plan."""
        return {} if obj else dict(self.prepopulated_fields)

    def has_delete_permission(self, request: HttpRequest, obj: Plan | None = None) -> bool:
        """Allow deletion only of drafts without events."""
        return obj is not None and obj.state == PlanState.DRAFT and not obj.events.exists()

    def get_changeform_initial_data(self, request: HttpRequest) -> dict[str, Any]:
        """Preset the user as owner."""
        return {"owner": request.user.pk, **super().get_changeform_initial_data(request)}

    def get_urls(self) -> list[URLPattern]:
        """Add the import of a file and the export of everything."""
        view = self.admin_site.admin_view
        return [
            path("import/", view(self.import_file), name="plans_plan_import"),
            path("export/", view(self.export_all), name="plans_plan_export"),
            *super().get_urls(),
        ]

    def import_file(self, request: HttpRequest) -> HttpResponse:
        """Import a file, or show its problems."""
        form = FileForm(request.POST or None, request.FILES or None)
        if request.method == "POST" and form.is_valid():
            text, pictures = form.cleaned_data["file"]
            try:
                lines = import_file(user=request.user, text=text, pictures=pictures)
            except EvaError as error:
                form.add_error("file", str(error))
            else:
                for line in lines or ["the file is empty"]:
                    messages.success(request, line)
                return redirect("admin:plans_plan_changelist")
        context = {
            **self.admin_site.each_context(request),
            "title": "Import",
            "form": form,
            "opts": self.opts,
        }
        return render(request, "plans/admin_import.html", context)

    def export_all(self, request: HttpRequest) -> HttpResponse:
        """Export all scenes and checkpoints and the newest version of each plan; with ?pictures as an archive."""
        newest = {plan.name: plan for plan in Plan.objects.order_by("version")}
        everything: dict[str, Any] = {
            "scenes": list(Scene.objects.all()),
            "checkpoints": list(Checkpoint.objects.all()),
            "plans": list(newest.values()),
        }
        if "pictures" in request.GET:
            return _download(export_archive(**everything), "lab.zip", "application/zip")
        return _download(export_toml(**everything), "lab.toml")

    @admin.action(description="Export as TOML")
    def export(self, request: HttpRequest, rows: QuerySet[Plan]) -> HttpResponse:
        """Export the selected plans with their scenes and checkpoints."""
        plans = _newest(rows)
        return _download(export_toml(plans=plans), f"{_title(plans)}.toml")

    @admin.action(description="Export with reference pictures (zip)")
    def export_archive(self, request: HttpRequest, rows: QuerySet[Plan]) -> HttpResponse:
        """Export the selected plans as an archive with the reference pictures of their positions."""
        plans = _newest(rows)
        return _download(export_archive(plans=plans), f"{_title(plans)}.zip", "application/zip")

    @admin.display(description="trials")
    def trials(self, plan: Plan) -> str:
        """Return the number of scheduled trials."""
        n = plan.slots.count() or plan.positions.count() * plan.checkpoints.count() * plan.repetitions
        return str(n)


class UseInline(ReadOnly, admin.TabularInline):
    """Table of the plans that a template has made."""

    model = TemplateUse
    extra = 0
    fields = ("at", "checkpoint", "plan")
    readonly_fields = fields


class TemplateForm(forms.ModelForm):
    """Form of a template."""

    policy = Table(required=False, help_text=PlanTemplate._meta.get_field("policy").help_text)

    class Meta:
        model = PlanTemplate
        fields = ("name", "title", "plan", "arm", "tag", "policy", "station", "copies", "active")

    def clean_policy(self) -> dict[str, Any]:
        """Return the policy's table; {} for an empty field: then everything is as in the deployment."""
        return self.cleaned_data["policy"] or {}


@admin.register(PlanTemplate)
class PlanTemplateAdmin(admin.ModelAdmin):
    """Admin page of templates."""

    form = TemplateForm
    list_display = ("name", "plan", "arm", "tag", "station", "active")
    list_select_related = ("plan", "arm", "station")
    inlines = (UseInline,)


def _newest(rows: QuerySet[Plan]) -> list[Plan]:
    return list({plan.name: plan for plan in rows.order_by("version")}.values())


def _title(plans: list[Plan]) -> str:
    return plans[0].name if len(plans) == 1 else "plans"


def _download(content: str | bytes, name: str, kind: str = "application/toml; charset=utf-8") -> HttpResponse:
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return HttpResponse(content, content_type=kind, headers=headers)
