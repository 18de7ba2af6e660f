"""Connection of the database backend; the module's name is the one that Django looks for."""

from __future__ import annotations

from django.db.backends.sqlite3 import base


class DatabaseWrapper(base.DatabaseWrapper):
    """Connection that closes the cursor of a transaction that could not begin.

    The exception refers to itself by its traceback, and so keeps the cursor alive until some thread collects garbage.
    That thread would then reset the cursor's statement, which waits as long as the cursor's connection waits for the
    database. If that thread itself has locked the database, both would wait for each other.
    """

    def _start_transaction_under_autocommit(self) -> None:
        with self.cursor() as cursor:
            cursor.execute(f"BEGIN {self.transaction_mode or ''}")
