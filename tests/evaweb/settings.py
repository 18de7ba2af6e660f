"""The settings of the tests: the product's own, with a data folder that no test shares with a lab."""

import atexit
import os
import shutil
import tempfile

if "EVA_TEST_DATA_DIR" in os.environ:
    os.environ["EVA_DATA_DIR"] = os.environ["EVA_TEST_DATA_DIR"]
else:
    os.environ["EVA_DATA_DIR"] = tempfile.mkdtemp(prefix="eva-tests-")
    atexit.register(shutil.rmtree, os.environ["EVA_DATA_DIR"], ignore_errors=True)
os.environ.setdefault("EVA_SECRET_KEY", "for tests alone")

from evaweb.settings import *
from tests.processes import PATIENCE_S

EVA_COMMAND_TIMEOUT_S = PATIENCE_S  # a test of what comes too late, or never, gives its own

PASSWORD_HASHERS = ["django.contrib.auth.hashers.MD5PasswordHasher"]

if str(DATABASES["default"]["ENGINE"]).endswith("sqlite3"):
    # A file, as in a lab: threads that share a database in memory never wait for each other's locks.
    DATABASES["default"]["TEST"] = {"NAME": DATA_DIR / f"test-{os.getpid()}.sqlite3"}
