"""Connection of the database backend; the module's name is the one that Django looks for."""

from __future__ import annotations

from django.db.backends.sqlite3 import base


class DatabaseWrapper(base.DatabaseWrapper):
    """Connection that closes the cursor of a transaction that could not begin.

    Otherwise two threads could wait for each other. The exception refers to itself by its traceback, and so keeps the
    cursor alive until some thread collects garbage. The collecting thread would then reset the cursor's statement, and
    this reset waits as long as the cursor's connection waits for the database. If the collecting thread itself has
    locked the database, neither could continue.
    """

    def _start_transaction_under_autocommit(self) -> None:
        with self.cursor() as cursor:
            cursor.execute(f"BEGIN {self.transaction_mode or ''}")
