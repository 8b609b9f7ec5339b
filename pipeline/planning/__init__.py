"""Plan a rig before it is bought: field, fringe, accuracy, exposure and board."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.planning.rig_choice import RigChoice
    from pipeline.planning.rig_plan import RigPlan, plan_rig

__all__ = ["RigChoice", "RigPlan", "plan_rig"]
__getattr__, __dir__ = lazily(__name__)
