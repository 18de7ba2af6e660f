"""Policies, one module per protocol. Each declares `Config` and `build`."""

# Module of each kind. It is imported only if a deployment names it.
KINDS = {
    "external": "runtime.policies.external",
    "gr00t": "runtime.policies.gr00t",
    "lerobot": "runtime.policies.lerobot",
    "mock": "runtime.policies.mock",
    "none": "runtime.policies.none",
    "openpi": "runtime.policies.openpi",
    "replay": "runtime.policies.replay",
    "roboarena": "runtime.policies.roboarena",
    "starvla": "runtime.policies.starvla",
    "xpolicylab": "runtime.policies.xpolicylab",
}
