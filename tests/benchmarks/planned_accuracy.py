"""What rigs measure over what `colorphase plan` says of them: simulated frames, decoded.

python tests/benchmarks/planned_accuracy.py
"""

import _tests_path  # noqa: F401
from support.planned_rigs import RIGS, limits_over_planned, measured

import tikernels
from pipeline.planning import RigPlan, plan_rig


def main() -> None:
    """Print tables of docs/studies.md."""
    tikernels.init("cpu")
    print("| rig | phase sigma, rad | plane: phase | depth | bust, most pixels: phase | depth |")
    print("|---|---|---|---|---|---|")
    for name, made in RIGS.items():
        tell(name, plan_rig(**made))
    tell("usual, half as bright", plan_rig(**RIGS["usual"]), 0.5)
    for name in ("usual", "hand-size, near"):
        tell(f"{name}, through a mosaic", plan_rig(**{**RIGS[name], "sensor": "bayer"}))
    print("\n| rig | lateral resolution, mm | across | along | mosaic, mm | across | along |")
    print("|---|---|---|---|---|---|---|")
    for name, made in RIGS.items():
        row = [name]
        for plan in (plan_rig(**made), plan_rig(**{**made, "sensor": "bayer"})):
            row += [f"{value:.2f}" for value in (plan.lateral_limit_mm, *limits_over_planned(plan))]
        print(f"| {' | '.join(row)} |", flush=True)


def tell(name: str, plan: RigPlan, share: float = 1.0) -> None:
    """Print a row: a plane's errors and most of a bust's, over the plan's; the light times a share."""
    phase_rad = plan.phase_sigma_rad if share == 1 else plan.dark_phase_sigma_rad
    depth_mm = phase_rad * plan.fringe.depth_per_rad_mm
    plane, bust = (measured(plan, scene, share) for scene in ("plane", "bust"))
    ratios = (
        *(plane.phase_rad / phase_rad, plane.depth_mm / depth_mm),
        *(bust.most_phase_rad / phase_rad, bust.most_depth_mm / depth_mm),
    )
    print(f"| {name} | {phase_rad:.4f} | " + " | ".join(f"{ratio:.2f}" for ratio in ratios) + " |", flush=True)


if __name__ == "__main__":
    main()
