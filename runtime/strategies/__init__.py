"""Inference strategies, one module each, which declares `Config`, `USES`, `query` and `merge`."""

# Module of each kind; imported only if a deployment names the kind.
KINDS = {
    "ensemble": "runtime.strategies.ensemble",
    "naive": "runtime.strategies.naive",
    "async": "runtime.strategies.overlap",
    "rtc": "runtime.strategies.rtc",
    "sync": "runtime.strategies.sync",
}
