"""Kinematics by PyRoki (Kim et al. 2025, arXiv:2505.03728), for users who have it: the same problem, solved in JAX.

PyRoki is on no package index: it and jaxls are installed from their repositories. Nothing of it is imported before
a deployment asks for it.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from robots import Group, Robot, urdf
from robots.chain import motions, motion_table
from robots.urdf import Joint
from runtime.errors import SetupError
from runtime.kinematics import compiled
from runtime.kinematics.base import IkResult, Kinematics, KinematicsError, KinematicsSettings
from runtime.kinematics.measuring import measured
from runtime.types import Float64
