"""Django's database backend for SQLite, whose cursors end in the thread that opened them."""
