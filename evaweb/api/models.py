"""Tokens of programs for the REST interface."""

from __future__ import annotations

from django.conf import settings
from django.db import models


class Token(models.Model):
    """Secret of one user, stored only as its SHA-256."""

    user = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.CASCADE, related_name="api_tokens")
    name = models.CharField(max_length=80, help_text="What uses it.")
    digest = models.CharField(max_length=64, unique=True, editable=False)
    created_at = models.DateTimeField(auto_now_add=True)
    ends_at = models.DateTimeField(editable=False)
    used_at = models.DateTimeField(null=True, blank=True, editable=False)

    class Meta:
        ordering = ("user", "name")
        constraints = [models.UniqueConstraint(fields=("user", "name"), name="token_name_once_per_user")]

    def __str__(self) -> str:
        return f"{self.name} of {self.user}"
