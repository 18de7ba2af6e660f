"""The settings of every Django process; all from the environment, and none is needed."""

from __future__ import annotations

import os
from importlib.metadata import files
from pathlib import Path

import dj_database_url
from django.core.exceptions import ImproperlyConfigured

from evaweb import environment

BASE_DIR = environment.checkout(Path(__file__).parents[1])
DATA_DIR = environment.data_dir(BASE_DIR / "data")

SECRET_KEY = environment.secret_key(DATA_DIR)
DEBUG = environment.flag("EVA_DEBUG", False)
ALLOWED_HOSTS = environment.words("EVA_ALLOWED_HOSTS", ("127.0.0.1", "localhost", "[::1]"))
CSRF_TRUSTED_ORIGINS = environment.words("EVA_TRUSTED_ORIGINS")

INSTALLED_APPS = [
    "evaweb.apps.LabAdminConfig",
    "django.contrib.auth",
    "django.contrib.contenttypes",
    "django.contrib.sessions",
    "django.contrib.messages",
    "django.contrib.staticfiles",
    "django_htmx",
    "channels",
    "evaweb.stations",
    "evaweb.jobs",
    "evaweb.episodes",
    "evaweb.reviews",
    "evaweb.trials",
    "evaweb.collect",
    "evaweb.plans",
    "evaweb.datasets",
    "evaweb.results",
    "evaweb.preflights",
    "evaweb.console",
    "evaweb.api",
    "evaweb.lab",
]

MIDDLEWARE = [
    "django.middleware.security.SecurityMiddleware",
    "whitenoise.middleware.WhiteNoiseMiddleware",
    "django.contrib.sessions.middleware.SessionMiddleware",
    "django.middleware.common.CommonMiddleware",
    "django.middleware.csrf.CsrfViewMiddleware",
    "django.contrib.auth.middleware.AuthenticationMiddleware",
    "django.contrib.auth.middleware.LoginRequiredMiddleware",
    "django.contrib.messages.middleware.MessageMiddleware",
    "django.middleware.clickjacking.XFrameOptionsMiddleware",
    "django_htmx.middleware.HtmxMiddleware",
    "evaweb.refusals.RefusalMiddleware",
]

ROOT_URLCONF = "evaweb.urls"
ASGI_APPLICATION = "evaweb.asgi.application"
LOGIN_URL = "login"
LOGIN_REDIRECT_URL = "home"
LOGOUT_REDIRECT_URL = "login"

TEMPLATES = [
    {
        "BACKEND": "django.template.backends.django.DjangoTemplates",
        "DIRS": [BASE_DIR / "templates"],
        "APP_DIRS": True,
        "OPTIONS": {
            "context_processors": [
                "django.template.context_processors.request",
                "django.contrib.auth.context_processors.auth",
                "django.contrib.messages.context_processors.messages",
            ],
            "builtins": ["evaweb.sight_tags"],  # no template names a checkpoint in another way
        },
    }
]

# --- database ----------------------------------------------------------------------------------------------

_SQLITE = {
    "transaction_mode": "IMMEDIATE",  # a writer that begins as a reader could not wait for its turn
    "timeout": 20,
    "init_command": "PRAGMA journal_mode=WAL; PRAGMA synchronous=FULL; PRAGMA foreign_keys=ON;",
}


def _database() -> dict[str, object]:
    url = os.environ.get("DATABASE_URL")
    if not url:
        # Whoever can read it can be everybody who is logged in.
        name = environment.private_file(DATA_DIR / "eva.sqlite3")
        return {"ENGINE": "django.db.backends.sqlite3", "NAME": name, "OPTIONS": _SQLITE}
    try:
        found = dj_database_url.parse(url, conn_max_age=60, conn_health_checks=True)
    except (ValueError, dj_database_url.ParseError) as error:
        raise ImproperlyConfigured(
            f"DATABASE_URL: {error}; for example postgres://user:password@host/name"
        ) from None
    environment.require_driver("DATABASE_URL", found["ENGINE"])
    if found["ENGINE"].endswith("sqlite3"):
        found["OPTIONS"] = _SQLITE
    return dict(found)


DATABASES = {"default": _database()}
DEFAULT_AUTO_FIELD = "django.db.models.BigAutoField"

# --- broker ------------------------------------------------------------------------------------------------

REDIS_URL = os.environ.get("REDIS_URL", "")  # of evaweb.celery; without it a folder of the data folder serves

# --- static files ------------------------------------------------------------------------------------------


def _viewer() -> Path:
    """The folder of the 3D viewer's script; the Python package around it is never imported."""
    for file in files("meshcat") or ():
        if file.name == "main.min.js" and file.parent.name == "dist":
            return Path(str(file.locate())).parent
    raise ImproperlyConfigured(
        "the package meshcat is installed without its viewer: pip install --force-reinstall meshcat"
    )


STATIC_URL = "static/"
STATIC_ROOT = DATA_DIR / "static"  # for a web server in front; our own processes serve from the sources
STATIC_ROOT.mkdir(exist_ok=True)
STATICFILES_DIRS: list[object] = [BASE_DIR / "static", ("meshcat", _viewer())]
_UPLOT = BASE_DIR / "node_modules" / "uplot" / "dist"
if _UPLOT.is_dir():  # `make setup` brings it; the system check of evaweb.console says so where it is absent
    STATICFILES_DIRS.append(("uplot", _UPLOT))
WHITENOISE_USE_FINDERS = True
WHITENOISE_MAX_AGE = 0  # names carry no hash: a browser asks each time, and is told that nothing changed

# --- language, security, log -------------------------------------------------------------------------------

LANGUAGE_CODE = "en-gb"
TIME_ZONE = environment.time_zone("EVA_TIME_ZONE", "UTC")
USE_TZ = True
SESSION_COOKIE_AGE = 14 * 24 * 3600
SESSION_COOKIE_SECURE = CSRF_COOKIE_SECURE = environment.flag("EVA_HTTPS", False)
SECURE_PROXY_SSL_HEADER = (
    ("HTTP_X_FORWARDED_PROTO", "https") if environment.flag("EVA_HTTPS", False) else None
)
SECURE_REFERRER_POLICY = "same-origin"
X_FRAME_OPTIONS = "DENY"
AUTHENTICATION_BACKENDS = [
    "django.contrib.auth.backends.ModelBackend",
    "evaweb.administration.RoleBackend",
]
PASSWORD_HASHERS = ["django.contrib.auth.hashers.PBKDF2PasswordHasher"]
AUTH_PASSWORD_VALIDATORS = [
    {"NAME": "django.contrib.auth.password_validation.UserAttributeSimilarityValidator"},
    {"NAME": "django.contrib.auth.password_validation.MinimumLengthValidator"},
    {"NAME": "django.contrib.auth.password_validation.CommonPasswordValidator"},
]
LOGGING = {
    "version": 1,
    "disable_existing_loggers": False,
    "formatters": {"line": {"format": "%(asctime)s %(levelname)s %(name)s: %(message)s"}},
    "handlers": {"console": {"class": "logging.StreamHandler", "formatter": "line"}},
    "root": {"handlers": ["console"], "level": environment.log_level("EVA_LOG_LEVEL", "INFO")},
}

# --- ours --------------------------------------------------------------------------------------------------

# How long a request waits for a station's answer [s]; after it the outcome is unknown.
EVA_COMMAND_TIMEOUT_S = environment.seconds("EVA_COMMAND_TIMEOUT_S", 2.0)
# Without a sign of life for so long a worker's job is taken from it [s].
EVA_JOB_STALE_S = environment.seconds("EVA_JOB_STALE_S", 60.0)
# How long a worker that is told to end may finish its job [s]; then it puts it back.
EVA_WORKER_GRACE_S = environment.seconds("EVA_WORKER_GRACE_S", 12.0)
