"""Forward and inverse kinematics, one module per backend, which declares `Config` and `build`."""

# Module of each kind; imported only if a deployment names the kind.
KINDS = {
    "compiled": "runtime.kinematics.compiled",
    "pyroki": "runtime.kinematics.pyroki",
}
