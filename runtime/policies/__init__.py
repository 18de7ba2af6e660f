"""One file per policy protocol. Each declares `Config` and `build`."""

# Each kind with its module, which is imported where a deployment names it.
KINDS = {
    "gr00t": "runtime.policies.gr00t",
    "lerobot": "runtime.policies.lerobot",
    "mock": "runtime.policies.mock",
    "none": "runtime.policies.none",
    "openpi": "runtime.policies.openpi",
    "replay": "runtime.policies.replay",
    "roboarena": "runtime.policies.roboarena",
    "starvla": "runtime.policies.starvla",
}
