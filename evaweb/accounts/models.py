"""What people state about themselves, and give to the lab, besides their account."""

from __future__ import annotations

from django.conf import settings
from django.db import models

from evaweb.accounts.orcid import check_orcid


class Profile(models.Model):
    """What a person states about themselves; a person without a row has stated nothing."""

    user = models.OneToOneField(
        settings.AUTH_USER_MODEL, primary_key=True, on_delete=models.CASCADE, related_name="profile"
    )
    orcid = models.CharField("ORCID iD", max_length=19, blank=True, validators=[check_orcid])

    def __str__(self) -> str:
        return f"profile of {self.user}"


class HubToken(models.Model):
    """Hugging Face token of a person, encrypted: evaweb.accounts.hub_tokens."""

    user = models.OneToOneField(
        settings.AUTH_USER_MODEL, primary_key=True, on_delete=models.CASCADE, related_name="hub_token"
    )
    encrypted = models.TextField()
    ending = models.CharField("ends in", max_length=4)
    entered_at = models.DateTimeField("entered")

    class Meta:
        verbose_name = "Hugging Face token"

    def __str__(self) -> str:
        return f"Hugging Face token of {self.user}"
