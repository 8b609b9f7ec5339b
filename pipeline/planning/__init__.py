"""What a rig will measure, before it is bought: field, fringe, accuracy, exposure and board."""

from pipeline.planning.rig_choice import RigChoice
from pipeline.planning.rig_plan import RigPlan, plan_rig

__all__ = ["RigChoice", "RigPlan", "plan_rig"]
