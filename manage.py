#!/usr/bin/env python
"""Django's command line: `python manage.py lab` brings up everything on one machine."""

import os
import sys

from django.core.exceptions import ImproperlyConfigured
from django.core.management import execute_from_command_line

from robots.broken_pipe import exit_on_broken_pipe


@exit_on_broken_pipe
def main() -> int:
    """Run the command line; return the exit code."""
    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    try:
        execute_from_command_line(sys.argv)
    except ImproperlyConfigured as error:
        sys.exit(f"cannot start: {error}")
    except KeyboardInterrupt:  # before the command listens to it
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
