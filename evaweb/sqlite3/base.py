"""The backend's connection: its name is what Django looks for."""

from __future__ import annotations

from django.db.backends.sqlite3 import base


class DatabaseWrapper(base.DatabaseWrapper):
    """A connection that closes the cursor of a transaction that could not begin.

    The error that says so refers to itself by its traceback, and keeps the cursor until some thread collects garbage.
    That would reset the cursor's statement, which waits for as long as its connection waits for the database: a
    thread that has the database locked would wait for those that wait for it.
    """

    def _start_transaction_under_autocommit(self) -> None:
        with self.cursor() as cursor:
            cursor.execute(f"BEGIN {self.transaction_mode or ''}")
