"""Pages for setting up a lab: first account, first steps, machine check, diagnostic bundle."""

from __future__ import annotations

from typing import Any

from django import forms
from django.contrib import messages
from django.contrib.auth import login
from django.contrib.auth.decorators import login_not_required
from django.contrib.auth.models import User
from django.contrib.auth.password_validation import validate_password
from django.core.exceptions import ValidationError
from django.http import FileResponse, HttpRequest, HttpResponse
from django.shortcuts import redirect, render
from django.urls import reverse
from django.views.decorators.http import require_GET, require_http_methods, require_POST

import robots
from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import EvaError, NotFound
from evaweb.jobs.models import JobStatus
from evaweb.jobs.workers import waiting_for
from evaweb.lab import deployments, first_account, first_steps, machine_check, services
from evaweb.lab.demo_rows import station_registered
from evaweb.lab.draft_form import form_of
from evaweb.lab.first_steps import Walk, walk
from evaweb.plans import image_store
from evaweb.plans.bench_checks import cameras_of, confirm_cameras
from evaweb.stations.selectors import station_get

_BACKEND = "django.contrib.auth.backends.ModelBackend"


# --- the first account ---------------------------------------------------------------------------------------


class FirstAccountForm(forms.Form):
    """Form with the code of the terminal, and the administrator's name and password."""

    code = forms.CharField(max_length=40, help_text="The terminal in which the lab was started shows it.")
    username = forms.CharField(max_length=150, label="Name", validators=[User.username_validator])
    password = forms.CharField(
        max_length=128,
        strip=False,
        help_text="Eight characters or more, and no common word.",
        widget=forms.PasswordInput(attrs={"autocomplete": "new-password"}),
    )

    def clean_code(self) -> str:
        """Check the code."""
        code: str = self.cleaned_data["code"]
        if not first_account.is_code(code):
            raise ValidationError("this is not the code that the lab shows in its terminal")
        return code

    def clean(self) -> dict[str, Any]:
        """Check the password by the lab's rules."""
        cleaned: dict[str, Any] = super().clean() or {}
        if "code" in cleaned and "password" in cleaned:  # no expensive check without the code
            user = User(username=cleaned.get("username", ""))
            try:
                validate_password(cleaned["password"], user)
            except ValidationError as weak:
                self.add_error("password", weak)
        return cleaned


@login_not_required
@require_http_methods(["GET", "HEAD", "POST"])
def make_first_account(request: HttpRequest) -> HttpResponse:
    """Create the first administrator of a lab, with the code that its terminal shows."""
    if not first_account.is_offered():
        return redirect("login")
    form = FirstAccountForm(request.POST or None)
    if request.method == "POST" and form.is_valid():
        credentials = {key: form.cleaned_data[key] for key in ("username", "password")}
        login(request, first_account.administrator_make(**credentials), backend=_BACKEND)
        return redirect("first-steps")
    return render(request, "registration/first_account.html", {"form": form})


# --- first steps ---------------------------------------------------------------------------------------------


@require_GET
def steps(request: HttpRequest) -> HttpResponse:
    """Render the steps to the first scored trial."""
    require_role(request.user, Role.ADMIN)
    return _steps(request)


@require_GET
def news(request: HttpRequest) -> HttpResponse:
    """Answer 204, with a header that reloads the page if the steps have changed since it was rendered."""
    require_role(request.user, Role.ADMIN)
    answer = HttpResponse(status=204)
    if _walk(request).mark != request.GET.get("mark", ""):
        answer["HX-Refresh"] = "true"
    return answer


@require_POST
def simulated(request: HttpRequest) -> HttpResponse:
    """Write the deployment of a simulated station."""
    require_role(request.user, Role.ADMIN)
    name = request.POST.get("station", "").strip()
    try:
        deployments.write_simulated(name=name, robot=request.POST.get("robot", ""))
    except EvaError as fault:
        return _steps(request, status=fault.status, fault=str(fault), simulated_name=name)
    return _to(name)


@require_http_methods(["GET", "HEAD", "POST"])
def draft(request: HttpRequest) -> HttpResponse:
    """Render the draft form as a fragment, or write the posted draft."""
    require_role(request.user, Role.ADMIN)
    if request.method != "POST":
        return render(request, "lab/draft_form.html", {"draft": form_of(request.GET.dict())})
    form = form_of(request.POST.dict())
    name = form.name.strip()
    values = {"name": name, "robot": form.robot, "task": form.task}
    try:
        stored = deployments.write_draft(**values, parts=form.tables)
    except EvaError as fault:
        return _steps(request, status=fault.status, draft_fault=str(fault), draft=form)
    station_registered(name=name, robot=form.robot, deployment=str(stored.path), simulated=False)
    return _to(name)


@require_GET
def check_draft(request: HttpRequest, name: str) -> HttpResponse:
    """Check a deployment with the runtime, and render the errors as a fragment of the page."""
    require_role(request.user, Role.ADMIN)
    return render(request, "lab/checked.html", {"faults": deployments.faults_of(_kept(name).path)})


@require_GET
def deployment(request: HttpRequest, name: str) -> HttpResponse:
    """Return the deployment file as a download."""
    require_role(request.user, Role.ADMIN)
    stored = _kept(name)
    return FileResponse(stored.path.open("rb"), as_attachment=True, filename=stored.path.name)


@require_POST
def again(request: HttpRequest, name: str) -> HttpResponse:
    """Make the lab try again to start a station."""
    require_role(request.user, Role.ADMIN)
    deployments.try_again(name=name)
    return _to(name)


@require_POST
def remove(request: HttpRequest, name: str) -> HttpResponse:
    """Remove the deployment of a station."""
    require_role(request.user, Role.ADMIN)
    deployments.remove(name=name)
    messages.success(request, f"{name} is removed")
    return _to("")


@require_GET
def camera(request: HttpRequest, name: str, camera: str) -> HttpResponse:
    """Return the current image of a camera."""
    require_role(request.user, Role.ADMIN)
    station = station_get(name=name)
    if camera not in cameras_of(station):
        raise NotFound(
            f"{name} has no camera {camera!r:.60}; it has {', '.join(cameras_of(station)) or 'none'}"
        )
    answer = HttpResponse(image_store.current_images(station, [camera])[camera], content_type="image/jpeg")
    answer["Cache-Control"] = "no-store"
    return answer


@require_POST
def cameras(request: HttpRequest, name: str) -> HttpResponse:
    """Confirm that each camera has its right name, or rename exchanged cameras in the deployment."""
    require_role(request.user, Role.ADMIN)
    station = station_get(name=name)
    chosen = {key: request.POST.get(f"shows.{key}", key) for key in cameras_of(station)}
    try:
        if all(key == right for key, right in chosen.items()):
            confirm_cameras(user=request.user, station=station, first=True)
        else:
            deployments.cameras_exchanged(name=name, shown=chosen)
            messages.success(request, f"the names are exchanged: start {name} anew, then look again")
    except EvaError as fault:
        return _steps(request, name, status=fault.status, fault=str(fault))
    return _to(name)


@require_POST
def scene(request: HttpRequest) -> HttpResponse:
    """Create the starter scene."""
    require_role(request.user, Role.ADMIN)
    first_steps.starter_scene()
    return _to(request.POST.get("station", ""))


def _walk(request: HttpRequest, name: str = "") -> Walk:
    return walk(name=name or request.GET.get("station", ""))


def _steps(request: HttpRequest, name: str = "", *, status: int = 200, **more: Any) -> HttpResponse:
    walk = _walk(request, name)
    context = {
        "walk": walk,
        "fresh": "new" in request.GET or "simulated_name" in more or "draft" in more,
        "robots": robots.robot_names(),
        "lab_runs": deployments.lab_runs(),
        "scenes": first_steps.scenes_address(),
        "command": deployments.command_of(walk.kept.path) if walk.kept else "",
        **more,
    }
    return render(request, "lab/first_steps.html", context, status=status)


def _to(name: str) -> HttpResponse:
    return redirect(reverse("first-steps", query={"station": name} if name else None))


def _kept(name: str) -> deployments.StoredDeployment:
    stored = deployments.stored_deployment(name)
    if stored is None:
        names = ", ".join(row.name for row in deployments.stored_deployments()) or "none yet"
        raise NotFound(f"{name!r:.80} has no deployment in the data folder; there are: {names}")
    return stored


# --- the machine ---------------------------------------------------------------------------------------------


@require_GET
def machine(request: HttpRequest) -> HttpResponse:
    """Render the machine check."""
    require_role(request.user, Role.ADMIN)
    return render(request, "lab/machine.html", {"lines": machine_check.lines()})


# --- the diagnostic bundle -----------------------------------------------------------------------------------


@require_http_methods(["GET", "HEAD", "POST"])
def diagnosis(request: HttpRequest) -> HttpResponse:
    """Render this administrator's bundles, or request a new one."""
    require_role(request.user, Role.ADMIN)
    if request.method == "POST":
        services.bundle_ask(user=request.user)
        return redirect("diagnosis")
    job, bundles = services.bundle_job(user=request.user), services.bundles(user=request.user)
    passing = job is not None and job.status in (JobStatus.QUEUED, JobStatus.RUNNING)
    context = {"job": job, "bundles": bundles, "passing": passing, "lacks": waiting_for(job) if job else ""}
    fragment = request.headers.get("HX-Request")
    answer = render(request, f"lab/{'bundles' if fragment else 'diagnosis'}.html", context)
    if fragment and not passing:
        answer["HX-Refresh"] = "true"  # another one can be requested
    return answer


@require_GET
def diagnosis_file(request: HttpRequest, file: str) -> HttpResponse:
    """Return one bundle as a download."""
    require_role(request.user, Role.ADMIN)
    path = services.bundle_get(user=request.user, name=file)
    return FileResponse(path.open("rb"), as_attachment=True, filename=path.name)
