"""URL configuration of all HTTP endpoints."""

from __future__ import annotations

from django.contrib import admin
from django.contrib.auth import views as auth_views
from django.contrib.auth.decorators import login_not_required
from django.http import HttpRequest, HttpResponse
from django.urls import include, path

from evaweb.accounts.account_page import account
from evaweb.accounts.password_change import OwnPasswordView
from evaweb.api.urls import urls as rest
from evaweb.lab import first_account


@login_not_required
async def healthz(request: HttpRequest) -> HttpResponse:
    """Return "ok" as long as this process works; neither database nor stations are checked."""
    return HttpResponse("ok\n", content_type="text/plain")


handler400, handler500 = "evaweb.serving.error_pages.bad_request", "evaweb.serving.error_pages.server_error"
urlpatterns = [
    path("healthz", healthz),
    path(
        "login/",
        auth_views.LoginView.as_view(
            redirect_authenticated_user=True,
            extra_context={"missing": first_account.is_missing, "offered": first_account.is_offered},
        ),
        name="login",
    ),
    path("logout/", auth_views.LogoutView.as_view(), name="logout"),
    path("account/", account, name="account"),
    path("password/", OwnPasswordView.as_view(), name="password"),
    path("admin/", admin.site.urls),
    path("api/v1/", rest),
    path("", include("evaweb.console.urls")),
    path("", include("evaweb.stations.urls")),
    path("", include("evaweb.datasets.urls")),
    path("", include("evaweb.episodes.urls")),
    path("", include("evaweb.trials.urls")),
    path("", include("evaweb.results.urls")),
    path("", include("evaweb.plans.urls")),
    path("", include("evaweb.preflights.urls")),
    path("", include("evaweb.setup.urls")),
    path("", include("evaweb.lab.urls")),
]
