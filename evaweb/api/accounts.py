"""Account of the caller."""

from __future__ import annotations

from typing import Any

from django.http import HttpRequest
from ninja import Router, Schema

from evaweb.accounts.profiles import orcids_of
from evaweb.accounts.roles import Role, role_of
from evaweb.api.responses import FAILURES

router = Router(tags=["accounts"])


class AccountOut(Schema):
    """The authenticated user; `orcid` is the ORCID iD that they state on their account's page, "" for none."""

    username: str
    name: str
    role: Role
    orcid: str


@router.get("/me", response={200: AccountOut, **FAILURES}, summary="The user that asks", url_name="me")
def get_account(request: HttpRequest) -> Any:
    """Return the user of the session or the token, with name, role and ORCID iD."""
    user = request.auth
    username = user.get_username()
    orcid = orcids_of([username]).get(username, "")
    return {"username": username, "name": user.get_full_name(), "role": role_of(user), "orcid": orcid}
