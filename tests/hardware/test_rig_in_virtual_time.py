"""What takes hours on a bench: many bursts, with any wiring, and clocks that drift apart."""

from itertools import islice

import numpy as np
import pytest
from support.virtual_rig import FRAMES, Faults, VirtualRig, random_faults

from hardware import rig as rig_module
from hardware.rig import Rejected, Rig

wirings = pytest.mark.parametrize("strobe, clock", [(True, True), (True, False), (False, True)])


def rejected_and_burst(monkeypatch, virtual, n_bursts=1, **kwargs):
    """Return why runs were thrown away, and how many frames of `n_bursts` bursts were mispaired."""
    monkeypatch.setattr(rig_module, "time", virtual)
    rejected: list[Rejected] = []
    with Rig(virtual.settings, virtual.open, rejected.append) as rig:
        wrong = sum(virtual.mispaired(burst) for burst in islice(rig.bursts(**kwargs), n_bursts))
    return [str(each.faults[0]) for each in rejected], wrong


@pytest.mark.parametrize("endless", [False, True])
@wirings
def test_random_faults_with_any_wiring(strobe, clock, endless, monkeypatch):
    """Every burst that is kept is right, and none that is good is thrown away.

    But where pulses run on and the camera tells no times, one whose frames come late is in doubt.
    """
    random = np.random.default_rng(5)
    fates: list[Faults] = []  # of this try
    n_failed = n_rejected = 0
    wrong: list[list[Faults]] = []
    lost: list[Rejected] = []

    def next_faults():
        # The third try is left alone.
        fates.append(random_faults(random) if n_failed < 2 else Faults())
        return fates[-1]

    def tell(rejected):
        nonlocal n_failed, n_rejected
        n_failed += 1
        n_rejected += 1
        lost.extend([rejected] * all(fate.harmless for fate in fates))
        fates.clear()

    virtual = VirtualRig(next_faults, strobe=strobe, clock=clock, trigger_ppm=200)
    monkeypatch.setattr(rig_module, "time", virtual)
    with Rig(virtual.settings, virtual.open, tell) as rig:
        for _ in range(150):
            for burst in islice(rig.bursts(endless=endless), 3):
                wrong.extend([list(fates)] * (virtual.mispaired(burst) > 0))
                n_failed = 0
                if not endless:
                    fates.clear()
            fates.clear()
    assert not wrong
    assert not lost or (endless and not clock)
    assert n_rejected > 50


@pytest.mark.parametrize("trigger_ppm", [-5000, 5000])
@wirings
def test_a_resonator_is_no_fault_in_endless_capture(strobe, clock, trigger_ppm, monkeypatch):
    """An Arduino Uno's clock is off by that much: by a second within minutes."""
    virtual = VirtualRig(strobe=strobe, clock=clock, trigger_ppm=trigger_ppm)
    assert rejected_and_burst(monkeypatch, virtual, 2000, endless=True) == ([], 0)


@pytest.mark.parametrize("fault", [Faults(lost_trigger=(0,)), Faults(lost_frame=(0,))])
@wirings
def test_the_first_frame_is_missing_in_endless_capture(strobe, clock, fault, monkeypatch):
    """None is missing between those that come, and they never end: only their times tell."""
    plan = [Faults(), fault]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), strobe=strobe, clock=clock)
    (reason,), wrong = rejected_and_burst(monkeypatch, virtual, 3, endless=True)
    assert wrong == 0
    cable = "trigger cable" if fault.lost_trigger or not strobe else "data cable"
    assert reason.startswith("pulse 0: ") and cable in reason, reason


def test_pulses_that_run_on_are_followed_without_strobes_and_clocks(monkeypatch):
    """A trigger that is lost where one burst's pulses follow another's leaves every later frame a period late."""
    plan = [Faults(), Faults(lost_trigger=(2 * FRAMES,))]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), strobe=False, clock=False)
    (reason,), wrong = rejected_and_burst(monkeypatch, virtual, 5, endless=True)
    assert wrong == 0 and "frames come 1.0 periods later than before: check the camera's trigger cable" in reason


@pytest.mark.parametrize("slow_s", [0.1, 0.3])
@wirings
def test_a_busy_line_costs_no_burst(strobe, clock, slow_s, monkeypatch):
    plan = [Faults(slow_line=((pulse, slow_s),)) for pulse in range(FRAMES)]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), strobe=strobe, clock=clock)
    assert rejected_and_burst(monkeypatch, virtual, FRAMES) == ([], 0)


@pytest.mark.parametrize(
    "fault, clock, message",
    [
        (Faults(cable_out=3), True, "pulse 3: 3 exposures to 6 pulses: check the camera's trigger cable"),
        (Faults(strobe_out=True), True, "0 exposures were counted for 6 frames: check the strobe cable"),
        (Faults(strobe_out=True), False, "0 exposures were counted for 6 frames: check the strobe cable"),
        (Faults(lost_strobe=(2,)), False, "pulse 2: 5 exposures were counted for 6 frames: check the strobe cable"),
        (Faults(lost_trigger=(1, 3, 5)), True, "pulse 1: the camera misses pulses regularly (3 exposures to 6)"),
        (Faults(lost_trigger=(2,), noise=((2, 0.5),)), False, "pulse 2: its exposure is off by 0.50 periods: check"),
        (Faults(lost_frame=(5,)), True, "pulse 5: only 5 frames of 6 exposures arrived: check the camera's data"),
    ],
)
def test_the_right_cable_is_named(fault, clock, message, monkeypatch):
    plan = [fault]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), clock=clock)
    (reason,), wrong = rejected_and_burst(monkeypatch, virtual)
    assert wrong == 0 and message in reason


def test_no_pulse_is_named_that_may_be_another(monkeypatch):
    """The first frame of six is lost, and the line is so slow that it might as well be the last."""
    plan = [Faults(lost_frame=(0,))]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults())
    (reason,), _ = rejected_and_burst(monkeypatch, virtual)
    assert reason.startswith("only 5 frames of 6 exposures arrived: check the camera's data cable")
