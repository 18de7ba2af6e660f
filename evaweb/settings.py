"""Django settings of all processes, read from environment variables; every one has a default."""

from __future__ import annotations

import logging
import os
from datetime import timedelta
from importlib.metadata import PackageNotFoundError, files, version
from pathlib import Path

import dj_database_url
from django.core.exceptions import ImproperlyConfigured

from evaweb.core import environment
from evaweb.serving import headers
from evaweb.serving.static_files import digest_of

BASE_DIR = environment.checkout(Path(__file__).parents[1])
DATA_DIR = environment.data_dir(BASE_DIR / "data")

SECRET_KEY = environment.secret_key(DATA_DIR)
DEBUG = environment.read_flag("EVA_DEBUG", False)
ALLOWED_HOSTS = environment.read_list("EVA_ALLOWED_HOSTS", ("127.0.0.1", "localhost", "[::1]"))
CSRF_TRUSTED_ORIGINS = environment.read_list("EVA_TRUSTED_ORIGINS")

INSTALLED_APPS = [
    "evaweb.apps.LabAdminConfig",
    "django.contrib.auth",
    "django.contrib.contenttypes",
    "django.contrib.sessions",
    "django.contrib.messages",
    "django.contrib.staticfiles",
    "django_htmx",
    "axes",
    "csp",
    "channels",
    "evaweb.accounts",
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
    "evaweb.setup",
    "evaweb.console",
    "evaweb.api",
    "evaweb.lab",
]

MIDDLEWARE = [
    "evaweb.serving.headers.HeadersMiddleware",
    "evaweb.serving.compression.CompressionMiddleware",
    "django.middleware.security.SecurityMiddleware",
    "csp.middleware.CSPMiddleware",
    "evaweb.accounts.cookies.AnySessionMiddleware",
    "django.middleware.common.CommonMiddleware",
    "django.middleware.csrf.CsrfViewMiddleware",
    "django.contrib.auth.middleware.AuthenticationMiddleware",
    "evaweb.serving.error_pages.LoginMiddleware",
    "django.contrib.messages.middleware.MessageMiddleware",
    "django.middleware.clickjacking.XFrameOptionsMiddleware",
    "django_htmx.middleware.HtmxMiddleware",
    "evaweb.serving.error_pages.RefusalMiddleware",
    "axes.middleware.AxesMiddleware",
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
            "builtins": [
                "evaweb.blinding.template_tags",  # templates get checkpoint names only through these tags
                "evaweb.core.language_tags",
                "evaweb.core.time_tags",
            ],
        },
    }
]

# --- database ----------------------------------------------------------------------------------------------

_SQLITE = {
    "transaction_mode": "IMMEDIATE",  # a transaction that starts as a reader cannot wait for the write lock
    "timeout": 20,
    "init_command": "PRAGMA journal_mode=WAL; PRAGMA synchronous=FULL; PRAGMA foreign_keys=ON; "
    "PRAGMA recursive_triggers=ON;",  # fires DELETE triggers for rows that REPLACE removes
}


_POSTGRESQL = {
    "connect_timeout": 10,  # shorter in the web: evaweb.core.lock_wait
    "tcp_user_timeout": 10_000,  # [ms], detects a server that has vanished
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
}


def _database() -> dict[str, object]:
    url = os.environ.get("DATABASE_URL")
    if not url:
        # Private, because readers of the session table could impersonate every logged-in user.
        name = environment.private_file(DATA_DIR / "eva.sqlite3")
        return {"ENGINE": "evaweb.sqlite3", "NAME": name, "OPTIONS": _SQLITE}
    try:
        # Each request has its own thread, so a persistent connection would never be used again.
        found = dj_database_url.parse(url, conn_max_age=0)
    except (ValueError, dj_database_url.ParseError) as error:
        raise ImproperlyConfigured(
            f"DATABASE_URL: {error}; for example postgres://user:password@host/name"
        ) from None
    environment.require_driver("DATABASE_URL", found["ENGINE"])
    if found["ENGINE"].endswith("sqlite3"):
        found |= {"ENGINE": "evaweb.sqlite3", "OPTIONS": _SQLITE}
    if found["ENGINE"].endswith("postgresql"):
        found["OPTIONS"] = {**_POSTGRESQL, **found.get("OPTIONS", {})}
    return dict(found)


DATABASES = {"default": _database()}
DEFAULT_AUTO_FIELD = "django.db.models.BigAutoField"

# --- broker ------------------------------------------------------------------------------------------------

REDIS_URL = os.environ.get(
    "REDIS_URL", ""
)  # broker of evaweb.celery; if empty, a folder in the data folder is the broker

# --- static files ------------------------------------------------------------------------------------------


def _viewer() -> Path | None:
    """Return the folder of the 3D viewer's script; its Python package and dependencies are never imported."""
    try:
        brought = files("meshcat") or ()
    except PackageNotFoundError:
        return None
    scripts = [file for file in brought if file.name == "main.min.js" and file.parent.name == "dist"]
    return Path(str(scripts[0].locate())).parent if scripts else None


LANGUAGES_DIR = BASE_DIR / "static" / "languages"  # translations, see evaweb.core.languages
STATICFILES_DIRS: list[Path | tuple[str, Path]] = [BASE_DIR / "static"]
# `make setup` installs both; a system check of evaweb.console reports a missing one.
for _name, _folder in (("meshcat", _viewer()), ("uplot", BASE_DIR / "node_modules" / "uplot" / "dist")):
    if _folder is not None and _folder.is_dir():
        STATICFILES_DIRS.append((_name, _folder))
_FOLDERS = [Path(entry[1] if isinstance(entry, tuple) else entry) for entry in STATICFILES_DIRS]
STATIC_DIGEST = "" if DEBUG else digest_of(_FOLDERS, *map(version, ("django", "django-htmx")))
STATIC_URL = f"static/{STATIC_DIGEST}/" if STATIC_DIGEST else "static/"

# --- language, security, log -------------------------------------------------------------------------------

LANGUAGE_CODE = "en-gb"
TIME_ZONE = environment.time_zone("EVA_TIME_ZONE", "UTC")
USE_TZ = True
# Cookies ignore ports: distinct names keep other labs and other Django programs on this host apart.
EVA_LAB_ID = environment.lab_id(DATA_DIR)
SESSION_COOKIE_NAME, CSRF_COOKIE_NAME = f"eva_session_{EVA_LAB_ID}", f"eva_csrf_{EVA_LAB_ID}"
MESSAGE_STORAGE = "django.contrib.messages.storage.session.SessionStorage"  # needs no cookie of its own
SESSION_COOKIE_AGE = 14 * 24 * 3600
_HTTPS = environment.read_flag("EVA_HTTPS", False)
SESSION_COOKIE_SECURE = CSRF_COOKIE_SECURE = _HTTPS
SECURE_PROXY_SSL_HEADER = ("HTTP_X_FORWARDED_PROTO", "https") if _HTTPS else None
# Time for which browsers insist on HTTPS for this name [s]; only a month, so that it can be revoked.
SECURE_HSTS_SECONDS = int(environment.read_seconds("EVA_HSTS_S", 30 * 24 * 3600)) if _HTTPS else 0
# Store of large immutable files: a folder or a bucket; None: the data folder.
EVA_STORE = environment.store()
# Age of closed recordings whose camera files are moved to the store [days]; None: never.
EVA_ARCHIVE_DAYS = environment.archive_days("EVA_ARCHIVE_DAYS", EVA_STORE is not None)
CONTENT_SECURITY_POLICY = headers.content_security_policy(getattr(EVA_STORE, "origin", ""))
SECURE_REFERRER_POLICY = "same-origin"
X_FRAME_OPTIONS = "DENY"
DEFAULT_EXCEPTION_REPORTER_FILTER = "evaweb.core.exception_reports.SecretFilter"
AUTHENTICATION_BACKENDS = [
    "axes.backends.AxesStandaloneBackend",
    "evaweb.serving.lockout_page.ManyNames",
    "django.contrib.auth.backends.ModelBackend",
    "evaweb.accounts.admin_site.RoleBackend",
]
PASSWORD_HASHERS = ["evaweb.accounts.password_hashing.QueuedHasher"]  # same hashes as PBKDF2PasswordHasher
AUTH_PASSWORD_VALIDATORS = [
    {"NAME": "django.contrib.auth.password_validation.UserAttributeSimilarityValidator"},
    {"NAME": "django.contrib.auth.password_validation.MinimumLengthValidator"},
    {"NAME": "django.contrib.auth.password_validation.CommonPasswordValidator"},
]
# A name is locked only at one address, so that users cannot be locked out from elsewhere.
AXES_LOCKOUT_PARAMETERS = [["username", "ip_address"]]
AXES_FAILURE_LIMIT = 5
AXES_COOLOFF_TIME = timedelta(minutes=15)
AXES_RESET_ON_SUCCESS = True
AXES_RESET_COOL_OFF_ON_FAILURE_DURING_LOCKOUT = False
AXES_CLIENT_IP_CALLABLE = "evaweb.accounts.client_addresses.lockable_of"
AXES_LOCKOUT_CALLABLE = "evaweb.serving.lockout_page.lockout_response"
AXES_SENSITIVE_PARAMETERS = ["username", "ip_address", "csrfmiddlewaretoken"]
AXES_DISABLE_ACCESS_LOG = True  # evaweb.accounts.login_audit logs logins and logouts
AXES_ENABLE_ADMIN = False  # evaweb.api.admin has its own page
AXES_VERBOSE = False


def _in_one_line(record: logging.LogRecord) -> bool:
    record.exc_info = None
    return True


LOGGING = {
    "version": 1,
    "disable_existing_loggers": False,
    "formatters": {"line": {"format": "%(asctime)s %(levelname)s %(name)s: %(message)s"}},
    "handlers": {"console": {"class": "logging.StreamHandler", "formatter": "line"}},
    "filters": {"in_one_line": {"()": "django.utils.log.CallbackFilter", "callback": _in_one_line}},
    "loggers": {
        "axes": {"level": "ERROR"},  # evaweb.accounts.login_audit logs the logins
        "django.security.DisallowedHost": {
            "filters": ["in_one_line"]
        },  # any client can cause it, so log one line without traceback
    },
    "root": {"handlers": ["console"], "level": environment.log_level("EVA_LOG_LEVEL", "INFO")},
}

# --- ours --------------------------------------------------------------------------------------------------

# Trusted proxies, which set X-Forwarded-For.
EVA_PROXIES = environment.read_networks("EVA_PROXIES")
# Address for stations on other computers; None: there are none. The next port receives their images.
EVA_GATE = environment.address("EVA_GATE")
# Host name by which those computers reach this one.
EVA_GATE_NAME = os.environ.get("EVA_GATE_NAME", "")
# Disk space that data from stations on other computers must leave free, set in [GB].
EVA_RESERVE_BYTES = int(1e9 * environment.gigabytes("EVA_RESERVE_GB", 5.0))
# Size of the local cache of a bucket's objects, set in [GB].
EVA_CACHE_BYTES = int(1e9 * environment.gigabytes("EVA_CACHE_GB", 10.0))
# Whether people without a Hugging Face token of their own push and pull with the worker's login.
EVA_HUB_LAB_ACCOUNT = environment.read_flag("EVA_HUB_LAB_ACCOUNT", True)
# Unread data buffered for a page before it is disconnected, set in [MiB].
EVA_UNREAD_BYTES = int(2**20 * environment.mebibytes("EVA_UNREAD_MIB", 8.0))
# Longest wait of a request for a station's answer [s]; after it the outcome is unknown.
EVA_COMMAND_TIMEOUT_S = environment.read_seconds("EVA_COMMAND_TIMEOUT_S", 2.0)
# Time without a heartbeat after which a worker's job is reclaimed [s].
EVA_JOB_STALE_S = environment.read_seconds("EVA_JOB_STALE_S", 60.0)
# Time for which a stopping worker may finish its job [s]; then the job is requeued.
EVA_WORKER_GRACE_S = environment.read_seconds("EVA_WORKER_GRACE_S", 12.0)
# Number of copies of simulated stations that a worker runs at the same time.
EVA_COPIES = environment.copies("EVA_COPIES", max(1, len(os.sched_getaffinity(0)) // 2))
# Niceness of a worker's process.
EVA_WORKER_NICE = environment.niceness("EVA_WORKER_NICE", 19)
