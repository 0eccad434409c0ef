"""The last rounds once more with an IMU, where it does not contradict the planes."""

from dataclasses import replace

from lvba.errors import DegenerateProblemError
from lvba.inertial import consistency
from lvba.inertial.consistency import InertialResult
from lvba.inertial.readings import Imu
from lvba.lidar import covariance as uncertainty
from lvba.lidar.config import Stage
from lvba.lidar.rounds import Rounds, Solved
from lvba.progress import Progress


def with_imu(
    rounds: Rounds, imu: Imu, stage: Stage, solved: Solved, progress: Progress
) -> tuple[Rounds, Solved, InertialResult]:
    """More rounds of the last stage with the IMU; where it contradicts the planes, all stays as it was without."""
    without, solved_without = replace(rounds, history=list(rounds.history)), solved
    if len(rounds.poses) > consistency.MOST_SCANS:
        judged = consistency.Judged(
            None, f"there are more than {consistency.MOST_SCANS} scans to solve together"
        )
    else:
        problem, directions, _ = solved
        steps = uncertainty.estimate(problem, rounds.poses).step
        judged = consistency.built(imu, rounds.poses, steps)
        if judged.factor is not None:
            judged = consistency.before(judged.factor, rounds.poses, steps, directions.count == 0)
    for _ in range(_IMU_TURNS):
        if judged.factor is None:
            break
        rounds.inertial = judged.factor
        try:
            solved = rounds.last(stage, progress, 0, stage.rounds)
        except DegenerateProblemError:
            judged = consistency.Judged(None, "with it, scans have no plane in common")
            break
        now = consistency.after(judged, rounds.poses)
        converged = now.factor is not None and (now.rotation, now.force) == (judged.rotation, judged.force)
        judged = judged if converged else now
        if converged:
            break
    if judged.factor is None:
        return without, solved_without, InertialResult(used=False, problem=judged.problem)
    return rounds, solved, consistency.result(judged, rounds.poses)


_IMU_TURNS = 3
"""Solutions with the IMU, each with the variances that the one before showed: the second one seldom changes them."""


def warnings(inertial: InertialResult | None) -> tuple[str, ...]:
    """That there is an IMU and it is not used."""
    if inertial is None or inertial.used:
        return ()
    return (f"the IMU is not used ({inertial.problem}): check units, axes, extrinsic and clock of imu.csv",)
