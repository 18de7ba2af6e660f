"""Admin pages of jobs: list, and retry of failed ones."""

from __future__ import annotations

from django.contrib import admin, messages
from django.db.models import QuerySet
from django.http import HttpRequest

from evaweb.jobs import services
from evaweb.jobs.kinds import ORDERED_BY, starts_elsewhere
from evaweb.jobs.models import Job, JobStatus


@admin.register(Job)
class JobAdmin(admin.ModelAdmin):
    """Admin page of jobs; only services write the rows."""

    list_display = (
        "key",
        "status",
        "attempts",
        "deaths",
        "queue",
        "created_at",
        "finished_at",
        "progress",
        "error",
    )
    list_filter = ("status", "kind", "queue")
    search_fields = ("key", "error")
    actions = ("try_again",)

    @admin.action(description="Try failed jobs again", permissions=("view",))
    def try_again(self, request: HttpRequest, jobs: QuerySet) -> None:
        failed = [
            job
            for job in jobs.filter(status=JobStatus.FAILED)
            if not starts_elsewhere(job.kind) and job.args.get(ORDERED_BY, request.user.pk) == request.user.pk
        ]
        for job in failed:
            services.retry_job(user=request.user, job=job)
        self.message_user(request, f"{len(failed)} asked for anew", messages.SUCCESS)

    def has_add_permission(self, request: HttpRequest) -> bool:
        return False

    def has_change_permission(self, request: HttpRequest, obj: Job | None = None) -> bool:
        return False

    def has_delete_permission(self, request: HttpRequest, obj: Job | None = None) -> bool:
        return False
