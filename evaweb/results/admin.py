"""Automatic judges in the administration; what they said is on the pages of results, where the blind is kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from django.contrib import admin, messages
from django.db.models import QuerySet
from django.http import HttpRequest

from evaweb.errors import EvaError
from evaweb.results.models import AutomaticJudge
from evaweb.results.ratings.automatic import judge_allow, judge_forbid


@admin.register(AutomaticJudge)
class AutomaticJudgeAdmin(admin.ModelAdmin):
    """Judges that can be asked; one with a server only once its address is allowed."""

    list_display = ("name", "kind", "address", "model", "allowed")
    readonly_fields = ("allowed",)
    actions = ("allow", "forbid")

    def get_readonly_fields(self, request: HttpRequest, obj: AutomaticJudge | None = None) -> tuple[str, ...]:
        return ("name", *self.readonly_fields) if obj else self.readonly_fields  # judgements have this name

    @admin.display(description="allowed")
    def allowed(self, judge: AutomaticJudge) -> str:
        """Who has allowed its address, and when."""
        if not judge.address:
            return "it has no address"
        if judge.allowed_address != judge.address or judge.allowed_at is None:
            return "no: nothing is sent there"
        return f"by {judge.allowed_by} on {judge.allowed_at:%Y-%m-%d %H:%M} UTC"

    @admin.action(description="Allow the address: pictures are sent there")
    def allow(self, request: HttpRequest, rows: QuerySet[AutomaticJudge]) -> None:
        """With who allowed it, here and in the history of the judge."""
        self._each(request, rows, judge_allow, "allowed its address")

    @admin.action(description="Allow the address no longer")
    def forbid(self, request: HttpRequest, rows: QuerySet[AutomaticJudge]) -> None:
        """Nothing more is sent there."""
        self._each(request, rows, judge_forbid, "allowed its address no longer")

    def _each(
        self, request: HttpRequest, rows: QuerySet[AutomaticJudge], act: Callable[..., None], said: str
    ) -> None:
        user: Any = request.user
        for judge in rows:
            try:
                act(user=user, judge=judge)
            except EvaError as fault:
                messages.error(request, str(fault))
                continue
            self.log_change(request, judge, f"{said}: {judge.address}")
            messages.success(request, f"{judge}: {said}")
