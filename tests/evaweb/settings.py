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

PASSWORD_HASHERS = ["django.contrib.auth.hashers.MD5PasswordHasher"]

WHITENOISE_AUTOREFRESH = (
    True  # looks for a file when it is asked for: each test's client would list all of them
)

if DATABASES["default"]["ENGINE"].endswith("sqlite3"):
    # A file, as in a lab: threads that share a database in memory never wait for each other's locks.
    DATABASES["default"]["TEST"] = {"NAME": DATA_DIR / f"test-{os.getpid()}.sqlite3"}
