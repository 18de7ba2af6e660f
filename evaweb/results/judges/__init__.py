"""Automatic judges, one module each, with `SEES`, `SERVED` and `build`; see base."""

# Module by kind, imported when a judge of that kind is used.
KINDS = {
    "bench": "evaweb.results.judges.bench",
    "chat": "evaweb.results.judges.chat",
}
