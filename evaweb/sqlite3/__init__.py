"""Django's database backend for SQLite, which closes cursors in the thread that opened them."""
