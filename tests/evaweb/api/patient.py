"""manage.py where nobody gives the database up: on a busy machine it only seems to be gone."""

from __future__ import annotations

import os
import sys

os.environ["DJANGO_SETTINGS_MODULE"] = "evaweb.settings"

import django
from django.core.management import execute_from_command_line

if __name__ == "__main__":
    django.setup()
    from evaweb.accounts import credentials  # not before models are there

    credentials._PATIENCE_S = credentials._TURN_S = 600.0
    execute_from_command_line(sys.argv)
