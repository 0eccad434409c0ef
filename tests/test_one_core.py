"""What exists once stays so: normal equations, the tangent and its retraction, the cost, the steps of a solver.

Each rule reads sources, names what is allowed elsewhere with the reason, and is shown a source that breaks it.
"""

import ast
from collections import Counter
from pathlib import Path

import pytest
from parsed import parsed

ROOT = Path(__file__).resolve().parent.parent
SOURCES = {
    path.relative_to(ROOT).as_posix(): path.read_text() for path in sorted((ROOT / "lvba").rglob("*.py"))
}
CORE = "lvba/optim/"

SOLVES = {
    "numpy.linalg": ("solve", "inv", "pinv", "lstsq"),
    "scipy.linalg": (
        "solve",
        "inv",
        "pinv",
        "lstsq",
        "cho_factor",
        "cho_solve",
        "lu_factor",
        "solve_triangular",
    ),
    "scipy.sparse.linalg": ("splu", "spsolve", "cg", "lsqr", "lsmr", "factorized"),
}

LINEAR_ALGEBRA = {
    "lvba/geometry.py": (1, "left Jacobian of SO(3), 3 x 3"),
    "lvba/steps/joint_cameras.py": (1, "scales of parts from exposure ratios: linear, one unknown each"),
    "lvba/blocks/lidar_joint.py": (2, "inverses of 6 x 6 information, rigid alignment"),
    "lvba/inertial/factor.py": (4, "whitening, 9 x 9; unknowns that all motions share, 16 x 16"),
    "lvba/io/kitti.py": (1, "camera center from a projection matrix, 3 x 3"),
    "lvba/lidar/bundle_adjustment.py": (1, "covariance of odometry steps, 6 x 6"),
    "lvba/lidar/covariance.py": (4, "6 x 6 information"),
    "lvba/lidar/dense_covariance.py": (2, "rigid alignment; all pairs of poses, whose blocks are taken"),
    "lvba/lidar/group_deletion.py": (2, "6 x 6 covariances as weights, rigid alignment"),
    "lvba/loop_closure/registration.py": (1, "map noise added to 6 x 6 information"),
    "lvba/loop_closure/scan_steps.py": (2, "two estimates of one step, directions that surfaces determine, 6 x 6"),
    "lvba/loop_closure/surfel_icp.py": (1, "6 x 6 information of an alignment"),
    "lvba/lidar/row_times.py": (1, "regression of the points' order on their directions"),
    "lvba/lidar/scan_motion.py": (2, "6 x 6 information of single scans"),
    "lvba/lidar/scan_evidence.py": (4, "numbers that scans share, at most 16 x 16; poses and planes eliminated"),
    "lvba/lidar/range_uncertainty.py": (3, "errors of a range sensor, at most 5 x 5; the place of a camera, 3 x 3"),
    "lvba/lidar/pose_response.py": (1, "the turn that all scans of a window have in common, 3 x 3"),
    "lvba/steps/error_chain.py": (6, "6 x 6 covariances of a chain's links"),
    "lvba/steps/pose_fusion.py": (4, "6 x 6 covariances of single scans"),
    "lvba/steps/uncertainty.py": (1, "normalized errors, 6 x 6"),
    "lvba/visual/bundle_adjustment.py": (1, "information of the shared parameters from their covariance, k x k"),
    "lvba/visual/calibration_prior.py": (7, "whitening by the calibration's information, variances, k x k"),
    "lvba/visual/vignetting.py": (2, "three coefficients and a center: at most 5 x 5"),
    "lvba/visual/radiometry.py": (2, "vignetting and response of a camera: 12 x 12"),
    "lvba/visual/fixed_calibration.py": (2, "estimates given that some are fixed, Wald tests: at most 8 x 8"),
    "lvba/visual/covariance.py": (4, "6 x 6 blocks: whitening, size of a wall's error, mean of map covariances"),
    "lvba/visual/exposure_graph.py": (1, "log exposures from ratios: linear, one unknown per image"),
}  # fmt: skip
"""File: how many solves or inverses outside the core, and of what."""

TURNS = {
    "lvba/geometry.py": (1, "the tangent itself: retract"),
    "lvba/inertial/factor.py": (2, "axes of an IMU that are turned a little; what a bias turns a motion by"),
    "lvba/lidar/rounds.py": (1, "a constant rotation of the grid of cells"),
    "lvba/loop_closure/correlation.py": (1, "a search over rotations, no steps"),
    "lvba/sources/importing/turning.py": (3, "rates of a gyroscope over its readings, no steps"),
    "lvba/visual/degeneracy.py": (1, "one motion of all cameras about a common center"),
    "lvba/visual/trajectory_prior.py": (1, "how far the LiDAR turns during the time offset"),
}
"""File: how many transforms are made of a tangent vector outside `geometry.retract`, and what for."""

DAMPED = {
    "lvba/lidar/problem.py": "settings of the one Levenberg-Marquardt",
    "lvba/visual/degeneracy.py": "settings of the one Levenberg-Marquardt",
    "lvba/visual/bundle_adjustment.py": "settings of the one Levenberg-Marquardt",
    "lvba/visual/refine.py": "settings of the one Levenberg-Marquardt, of coarse levels",
    "lvba/blocks/lidar_joint.py": "joint rounds: damping from round to round, `levenberg_marquardt.raised` and `eased`",
    "lvba/blocks/visual_joint.py": "joint rounds, as above",
}
"""File: why a name with `damping` is in it."""

FULL_SQUARES = {
    "lvba/lidar/bundle_adjustment.py": "squared residuals per point, told beside their expectation 1",
    "lvba/lidar/rounds.py": "squared residuals per point and per unknown, told beside their expectation 1",
    "lvba/blocks/lidar_joint.py": "squared residuals per point",
    "lvba/steps/joint_scans.py": "squared residuals per point",
}
"""File: why twice a cost is in it."""


def imported(tree: ast.Module) -> dict[str, str]:
    """What each name of a module stands for, dotted."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                found[alias.asname or alias.name.split(".")[0]] = (
                    alias.name if alias.asname else alias.name.split(".")[0]
                )
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update({alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names})
    return found


def dotted(node: ast.expr, names: dict[str, str]) -> str:
    """`np.linalg.solve` as numpy.linalg.solve; empty where a call is of something else."""
    if isinstance(node, ast.Name):
        return names.get(node.id, node.id)
    if isinstance(node, ast.Attribute):
        before = dotted(node.value, names)
        return f"{before}.{node.attr}" if before else ""
    return ""


def calls(source: str, wanted: set[str]) -> int:
    tree = parsed(source)
    names = imported(tree)
    return sum(isinstance(node, ast.Call) and dotted(node.func, names) in wanted for node in ast.walk(tree))


def solves(source: str) -> int:
    return calls(source, {f"{module}.{name}" for module, each in SOLVES.items() for name in each})


def turns(source: str) -> int:
    return calls(
        source,
        {"lvba.geometry.exp", "exp", "scipy.spatial.transform.Rotation.from_rotvec", "scipy.linalg.expm"},
    )


def equation_classes(source: str) -> list[str]:
    endings = (
        "Equations",
        "Hessian",
        "LinearSystem",
        "Solver",
        "Minimizer",
        "LevenbergMarquardt",
        "GaussNewton",
    )
    return [
        n.name for n in ast.walk(parsed(source)) if isinstance(n, ast.ClassDef) and n.name.endswith(endings)
    ]


def damped_names(source: str) -> set[str]:
    """Names and attributes that a source assigns to or passes, of dampings, trust regions and gain ratios."""
    words = ("damping", "lambda_", "trust_radius", "gain_ratio", "line_search")
    found = set()
    for node in ast.walk(parsed(source)):
        each = (
            node.id if isinstance(node, ast.Name)
            else node.attr if isinstance(node, ast.Attribute)
            else node.arg if isinstance(node, ast.arg | ast.keyword) and node.arg
            else node.name if isinstance(node, ast.FunctionDef)
            else ""
        )  # fmt: skip
        if any(word in each for word in words):
            found.add(each)
    return found


def doubled_costs(source: str) -> int:
    """Products of two and something named cost."""
    found = 0
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            sides = [node.left, node.right]
            two = any(isinstance(side, ast.Constant) and side.value in (2, 2.0) for side in sides)
            found += two and any("cost" in ast.unparse(side).lower() for side in sides)
    return found


def outside_the_core() -> dict[str, str]:
    return {path: source for path, source in SOURCES.items() if not path.startswith((CORE, "lvba/simulate/"))}


def test_normal_equations_and_solvers_are_one_class_each():
    where = Counter(name for source in SOURCES.values() for name in equation_classes(source))
    # what one block says of the joint LiDAR problem holds the equations and what goes with them, and two levels two
    assert where == {"NormalEquations": 1, "BlockEquations": 1, "TwoLevelEquations": 1}
    assert equation_classes(SOURCES["lvba/optim/normal_equations.py"]) == ["NormalEquations"]


def test_linear_systems_are_solved_in_the_core():
    found = {path: n for path, source in outside_the_core().items() if (n := solves(source))}
    allowed = {path: count for path, (count, _) in LINEAR_ALGEBRA.items()}
    assert {path: n for path, n in found.items() if n > allowed.get(path, 0)} == {}
    assert set(allowed) <= set(found), "the list names files that solve nothing any more"


def test_transforms_move_by_one_retraction():
    found = {path: n for path, source in outside_the_core().items() if (n := turns(source))}
    allowed = {path: count for path, (count, _) in TURNS.items()}
    assert {path: n for path, n in found.items() if n > allowed.get(path, 0)} == {}
    assert set(allowed) <= set(found), "the list names files that turn nothing any more"
    assert sum(source.count("def retract(a_from_b") for source in SOURCES.values()) == 1


def test_steps_are_damped_and_accepted_in_the_core():
    found = {path for path, source in outside_the_core().items() if damped_names(source)}
    assert found == set(DAMPED)


def test_the_cost_is_half_the_sum_of_squares_and_nobody_doubles_it():
    found = {path for path, source in SOURCES.items() if doubled_costs(source)}
    assert found == set(FULL_SQUARES)


@pytest.mark.parametrize(
    ("rule", "source"),
    [
        (solves, "import numpy as np\nstep = -np.linalg.solve(h, g)"),
        (solves, "from numpy import linalg\nstep = linalg.inv(h) @ g"),
        (solves, "from scipy.linalg import cho_factor as cf\nf = cf(h)"),
        (solves, "import scipy.sparse.linalg as sla\nf = sla.splu(h)"),
        (turns, "from lvba import geometry\npose = pose @ geometry.exp(step)"),
        (turns, "from scipy.spatial.transform import Rotation\nr = r @ Rotation.from_rotvec(w).as_matrix()"),
        (equation_classes, "class PoseNormalEquations: ..."),
        (equation_classes, "class DampedSolver: ..."),
        (damped_names, "for _ in range(9):\n    self.damping *= 10"),
        (damped_names, "def line_search(state): ..."),
        (doubled_costs, "chi = 2.0 * found.cost_after / points"),
    ],
)  # fmt: skip
def test_each_rule_sees_what_breaks_it(rule, source):
    assert rule(source)


@pytest.mark.parametrize("rule", [solves, turns, equation_classes, damped_names, doubled_costs])
def test_no_rule_sees_what_is_in_order(rule):
    source = """
import numpy as np
from lvba import geometry
from lvba.optim.levenberg_marquardt import levenberg_marquardt
scale = np.exp(state.log_exposure) * 2.0
cost = 0.5 * float(np.sum(residual**2))
found = levenberg_marquardt(poses, linearize, lambda at, step: geometry.retract(at, step.blocks))
"""
    assert not rule(source)
