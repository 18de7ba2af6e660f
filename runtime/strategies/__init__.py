"""One file per inference strategy. Each declares `Config`, `query` and `merge`."""

# Each kind with its module, which is imported where a deployment names it.
KINDS = {
    "ensemble": "runtime.strategies.ensemble",
    "naive": "runtime.strategies.naive",
    "async": "runtime.strategies.overlap",
    "rtc": "runtime.strategies.rtc",
    "sync": "runtime.strategies.sync",
}
