"""What footage costs in phase before it is decoded, and what to change; `docs/footage.md` says how each is found."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.diagnosis.container import container_facts
from pipeline.diagnosis.footage_evidence import gather_evidence
from pipeline.diagnosis.footage_findings import (
    GRADES,
    FootageFinding,
    Grade,
    container_findings,
    frame_findings,
    fringe_findings,
    light_findings,
    not_told,
    storage_findings,
    time_findings,
)
from pipeline.diagnosis.frame_evidence import FrameQuality
from pipeline.footage.opening import open_source
from pipeline.footage.source import StoredAs
from pipeline.settings import DecodeSettings
from tikernels import runtime

#: Exit code for footage that should not be used as it is.
NOT_AS_IT_IS = 3


@dataclass(frozen=True)
class Inspection:
    """What footage is like: every finding, the container's first."""

    findings: tuple[FootageFinding, ...]
    not_told: tuple[str, ...]  # what these frames cannot tell, a sentence each
    n_looked_at: int
    n_frames: int

    @property
    def grade(self) -> Grade:
        """The worst of all findings."""
        return max((finding.grade for finding in self.findings), key=GRADES.index)

    def topics(self, grade: Grade) -> tuple[str, ...]:
        """Return what has this grade."""
        return tuple(finding.topic for finding in self.findings if finding.grade == grade)

    def as_json(self) -> dict[str, Any]:
        """Return all of it for programs."""
        return {"grade": self.grade, **asdict(self)}


def inspect_footage(
    path: str | Path,
    says: StoredAs | None = None,
    settings: DecodeSettings | None = None,
    arch: str = "auto",
    tell: Callable[[str], None] = lambda _: None,
) -> Inspection:
    """Look at some twenty frames, however many there are, and say what their phase suffers from.

    Parameters
    ----------
    path : str or Path
        What `open_source` opens.
    says : StoredAs, optional
        What the user says of how pixels are stored.
    settings : DecodeSettings, optional
        How the footage is meant to be decoded.
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        Where to compute.
    tell : callable
        Is told what is being done.

    Raises
    ------
    FootageError
        It cannot be read at all.
    DeviceNotReady
        The machine lacks the arch.
    """
    says, settings = says or StoredAs(), settings or DecodeSettings()
    tell("opening")
    source = open_source(path, **vars(says))
    try:
        runtime.init(arch)
        facts = container_facts(Path(path), source)
        seen = gather_evidence(source, says, settings, arch, tell)
    finally:
        source.close()
    findings = [*container_findings(facts, source), *frame_findings(seen, facts, settings)]
    open_questions = []
    if facts.missing is None and len(source) > 1:
        open_questions.append(
            "whether frames are missing between others: neither even time stamps nor numbers in names tell"
        )
    if seen.kept:
        typical = FrameQuality(*np.median([list(vars(shown).values()) for shown in seen.qualities], axis=0).tolist())
        findings += [
            *fringe_findings(seen, typical),
            *storage_findings(seen, facts, source, typical),
            *light_findings(seen, typical),
            *time_findings(seen, typical),
        ]
        open_questions += not_told(seen, facts, source)
    if seen.n_frames < len(source):
        open_questions.append(
            f"what is wrong in frames between the {seen.n_frames} of {len(source)} that were looked at"
        )
    return Inspection(tuple(findings), tuple(open_questions), seen.n_frames, len(source))
