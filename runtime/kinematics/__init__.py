"""Forward and inverse kinematics: one file per backend. Each declares `Config` and `build`."""

# Each kind with its module, which is imported where a deployment names it.
KINDS = {
    "compiled": "runtime.kinematics.compiled",
    "pyroki": "runtime.kinematics.pyroki",
}
