"""Admin pages of reviews: rows are read-only, but the labels of segments can be edited.

Only services write the rows, after they have written the same content to the disk.
"""

from __future__ import annotations

from django.contrib import admin
from django.http import HttpRequest

from evaweb.accounts.admin_site import LabelledRows
from evaweb.reviews.models import Review, Segment, SegmentLabel, Standing


class _ReadOnlyAdmin(admin.ModelAdmin):
    """Base of admin pages of read-only records."""

    def has_add_permission(self, request: HttpRequest) -> bool:
        return False

    def has_change_permission(self, request: HttpRequest, obj: object = None) -> bool:
        return False

    def has_delete_permission(self, request: HttpRequest, obj: object = None) -> bool:
        return False


@admin.register(Review)
class ReviewAdmin(_ReadOnlyAdmin):
    """Admin page of verdicts and notes on episodes."""

    list_display = ("episode", "verdict", "note", "reviewer", "at")
    list_filter = ("verdict", "reviewer")
    search_fields = ("episode__uuid", "note")
    list_select_related = ("episode", "reviewer")


@admin.register(Segment)
class SegmentAdmin(_ReadOnlyAdmin):
    """Admin page of annotated segments."""

    list_display = ("episode", "first", "last", "label", "milestone", "annotator", "at")
    list_filter = ("annotator",)
    search_fields = ("episode__uuid", "label", "milestone")
    list_select_related = ("episode", "annotator")


@admin.register(Standing)
class StandingAdmin(_ReadOnlyAdmin):
    """Admin page of check results, and of the verdict that counts for each episode."""

    list_display = ("episode", "worst", "flags", "checked_at", "review")
    list_filter = ("worst", "clean")
    search_fields = ("episode__uuid",)
    list_select_related = ("episode", "review")


@admin.register(SegmentLabel)
class SegmentLabelAdmin(LabelledRows, admin.ModelAdmin):
    """Admin page of the vocabulary of segments, which Replay offers in this order."""

    list_display = ("words", "colour", "key", "order", "active")
    list_editable = ("colour", "key", "order", "active")
