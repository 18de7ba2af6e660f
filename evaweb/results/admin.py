"""Administration of automatic judges; their judgements are on the result pages, which respect blinding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from django.contrib import admin, messages
from django.db.models import QuerySet
from django.http import HttpRequest

from evaweb.core.errors import EvaError
from evaweb.results.models import AutomaticJudge
from evaweb.results.ratings.automatic import judge_allow, judge_forbid


@admin.register(AutomaticJudge)
class AutomaticJudgeAdmin(admin.ModelAdmin):
    """Administration of the judges; a judge with a server is usable only after its address was allowed."""

    list_display = ("name", "kind", "address", "model", "allowed")
    readonly_fields = ("allowed",)
    actions = ("allow", "forbid")

    def get_readonly_fields(self, request: HttpRequest, obj: AutomaticJudge | None = None) -> tuple[str, ...]:
        return ("name", *self.readonly_fields) if obj else self.readonly_fields  # judgements refer to it

    @admin.display(description="allowed")
    def allowed(self, judge: AutomaticJudge) -> str:
        """Return who allowed the judge's address and when, or why nothing is sent."""
        if not judge.address:
            return "it has no address"
        if judge.allowed_address != judge.address or judge.allowed_at is None:
            return "no: nothing is sent there"
        return f"by {judge.allowed_by} on {judge.allowed_at:%Y-%m-%d %H:%M} UTC"

    @admin.action(description="Allow the address: pictures are sent there")
    def allow(self, request: HttpRequest, rows: QuerySet[AutomaticJudge]) -> None:
        """Allow the addresses of the selected judges; each judge's history records who allowed it."""
        self._each(request, rows, judge_allow, "allowed its address")

    @admin.action(description="Allow the address no longer")
    def forbid(self, request: HttpRequest, rows: QuerySet[AutomaticJudge]) -> None:
        """Withdraw the permission of the selected judges: nothing more is sent to their addresses."""
        self._each(request, rows, judge_forbid, "allowed its address no longer")

    def _each(
        self, request: HttpRequest, rows: QuerySet[AutomaticJudge], act: Callable[..., None], label: str
    ) -> None:
        user: Any = request.user
        for judge in rows:
            try:
                act(user=user, judge=judge)
            except EvaError as fault:
                messages.error(request, str(fault))
                continue
            self.log_change(request, judge, f"{label}: {judge.address}")
            messages.success(request, f"{judge}: {label}")
