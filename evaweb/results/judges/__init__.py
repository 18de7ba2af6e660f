"""One file per automatic judge. Each declares `SEES`, `SERVED` and `build`; see base."""

# Each kind with its module, which is imported where a judge of that kind is asked.
KINDS = {
    "bench": "evaweb.results.judges.bench",
    "chat": "evaweb.results.judges.chat",
}
