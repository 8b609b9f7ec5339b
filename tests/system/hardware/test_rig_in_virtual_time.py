"""What takes hours on a bench: many bursts, with any wiring, and clocks that drift apart."""

import re
from itertools import islice, product

import numpy as np
import pytest
from support.virtual_rig import FRAMES, PERIOD_S, Faults, Instruments, VirtualRig, random_faults

from hardware import rig as rig_module
from hardware.errors import BurstError
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

    def notify(rejected):
        nonlocal n_failed, n_rejected
        n_failed += 1
        n_rejected += 1
        lost.extend([rejected] * all(fate.harmless for fate in fates))
        fates.clear()

    virtual = VirtualRig(next_faults, strobe=strobe, clock=clock, trigger_ppm=200)
    monkeypatch.setattr(rig_module, "time", virtual)
    with Rig(virtual.settings, virtual.open, notify) as rig:
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


@pytest.mark.parametrize("start_s", [(5e-4, 5e-4), (0.03, 0.02)])
def test_the_first_trigger_is_lost_after_bursts_whose_frames_came_late(start_s, monkeypatch):
    """By their arrival, frames then come no later than before: only the camera's clock shows it."""
    for late, seed in product(np.linspace(0.2, 1.2, 6), range(20)):
        lose_the_first_trigger(start_s, late, seed, monkeypatch)


def lose_the_first_trigger(start_s, late, seed, monkeypatch):
    rejected: list[Rejected] = []

    def next_faults():
        runs_on = virtual.train.count is None
        return Faults(lost_trigger=(0,)) if runs_on and not rejected else Faults(late_s=late * PERIOD_S)

    virtual = VirtualRig(next_faults, instruments=Instruments(strobe=False, start_s=start_s), seed=seed)
    monkeypatch.setattr(rig_module, "time", virtual)
    with Rig(virtual.settings, virtual.open, rejected.append) as rig:
        wrong = sum(virtual.mispaired(burst) for burst in islice(rig.bursts(endless=True), 3))
    found = [str(each.faults[0]) for each in rejected]
    case = f"late by {late:.1f} periods, seed {seed}: {wrong} mispaired, {found}"
    assert wrong == 0 and len(found) == 1, case
    assert re.match(r"pulse 0: frames come (0\.9|1\.[01]) periods later", found[0]), case


@pytest.mark.parametrize("numbers, clock", [(True, True), (True, False), (False, False)])
@pytest.mark.parametrize("strobe", [True, False])
def test_frames_that_arrive_late_cost_no_burst_of_pulses_that_run_on(strobe, numbers, clock, monkeypatch):
    """At 200 frames a second a machine that is busy for some milliseconds is late by more than half a period."""
    random = np.random.default_rng(2)

    def busy():
        pulses = np.flatnonzero(random.random(600) < 0.1)
        return Faults(slow_line=tuple((int(pulse), float(random.exponential(5e-3))) for pulse in pulses))

    plan = [Faults(), Faults()]  # two bursts must agree first, where only arrival tells
    has = Instruments(strobe=strobe, numbers=numbers, clock=clock)
    for _ in range(5):
        virtual = VirtualRig(lambda: plan.pop(0) if plan else busy(), instruments=has, period_s=5e-3)
        assert rejected_and_burst(monkeypatch, virtual, 100, endless=True) == ([], 0)


@pytest.mark.parametrize(
    "has",
    [
        Instruments(strobe=False, starts_anew=True),  # the trigger too many shows in the camera's clock
        Instruments(clock=False),  # in the exposures, as in the next
        Instruments(clock=False, numbers=False),
    ],
)
@pytest.mark.parametrize("pulse", [3, 4, 9])
def test_a_trigger_too_many_does_not_make_up_for_a_lost_frame_before(has, pulse, monkeypatch):
    """Frames behind it come in time again, a pulse too late: what was lost is no mere lateness."""
    rejected: list[Rejected] = []

    def next_faults():
        runs_on = virtual.train.count is None
        return Faults(lost_frame=(0,), noise=((pulse, 0.5),)) if runs_on and not rejected else Faults()

    virtual = VirtualRig(next_faults, instruments=has, period_s=5e-3, frames=1)
    monkeypatch.setattr(rig_module, "time", virtual)
    with Rig(virtual.settings, virtual.open, rejected.append) as rig:
        assert sum(virtual.mispaired(burst) for burst in islice(rig.bursts(endless=True), 8)) == 0
    assert rejected


@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("fault", [Faults(lost_frame=(0,)), Faults(lost_trigger=(0,), noise=((0, 0.4),))])
def test_bursts_of_one_frame(fault, endless, monkeypatch):
    """Nothing comes of the only pulse, or something else exposed its frame."""
    plan = [Faults(), fault]  # the first shows when exposures follow pulses
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), frames=1)
    (reason,), wrong = rejected_and_burst(monkeypatch, virtual, 2, endless=endless)
    assert wrong == 0 and reason.startswith("pulse 0: ")


def test_a_frame_of_the_burst_before_comes_once_more(monkeypatch):
    """Its number is that of the burst's own, where numbers begin anew."""
    has = Instruments(clock=False, starts_anew=True)
    plan = [Faults(), Faults(), Faults(stale_frame=True)]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), instruments=has, frames=1)
    assert rejected_and_burst(monkeypatch, virtual, 4) == ([], 0)


def test_a_start_that_takes_long_is_repeated_and_no_fault(monkeypatch):
    """The trigger source may have begun a period late: what follows could hide a lost trigger."""
    plan = [Faults(slow_start=(0.0, 0.03)), Faults()]
    fired = []

    def next_faults():
        fired.append(plan.pop(0) if plan else Faults())
        return fired[-1]

    virtual = VirtualRig(next_faults, strobe=False)
    assert rejected_and_burst(monkeypatch, virtual, 3, endless=True) == ([], 0)
    assert len(fired) == 4


def test_a_start_that_always_takes_long_is_refused_with_what_to_do(monkeypatch):
    def next_faults():
        return Faults(slow_start=(0.0, 0.05 * (virtual.train.count is not None)))

    virtual = VirtualRig(next_faults, strobe=False)
    with pytest.raises(
        BurstError, match=r"the start took 0\.05. s, which may hide a lost trigger: make the period longer"
    ):
        rejected_and_burst(monkeypatch, virtual, endless=True)


@pytest.mark.parametrize("pulse", [1, FRAMES, 2 * FRAMES - 1])
def test_a_single_picture_that_is_lost_while_pulses_run_on(pulse, monkeypatch):
    plan = [Faults(), Faults(lost_picture=(pulse,))]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), instruments=Instruments(vsync=True))
    (reason,), wrong = rejected_and_burst(monkeypatch, virtual, 4, endless=True)
    assert wrong == 0 and "pictures to" in reason


def test_the_cameras_count_shows_triggers_that_it_ignored(monkeypatch):
    """A spurious trigger while it exposes does no harm, but comes of a bad cable; one that it takes does."""
    plan = [Faults(noise=((2, 0.2),))]
    has = Instruments(strobe=False, clock=False, counter=True)
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), instruments=has)
    (reason,), wrong = rejected_and_burst(monkeypatch, virtual)
    assert wrong == 0 and "pulse 3: the camera ignored 1 triggers before it" in reason


def test_pulses_that_run_on_are_followed_without_strobes_and_clocks(monkeypatch):
    """A trigger that is lost where one burst's pulses follow another's leaves every later frame a period late."""
    plan = [Faults(), Faults(), Faults(lost_trigger=(2 * FRAMES,))]  # two bursts must agree first
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), strobe=False, clock=False)
    (reason,), wrong = rejected_and_burst(monkeypatch, virtual, 5, endless=True)
    assert wrong == 0 and "frames come 1.0 periods later than before: the camera's trigger cable" in reason


@pytest.mark.parametrize("slow_s", [0.1, 0.3])
@wirings
def test_a_busy_line_costs_no_burst(strobe, clock, slow_s, monkeypatch):
    plan = [Faults(slow_line=((pulse, slow_s),)) for pulse in range(FRAMES)]
    virtual = VirtualRig(lambda: plan.pop(0) if plan else Faults(), strobe=strobe, clock=clock)
    assert rejected_and_burst(monkeypatch, virtual, FRAMES) == ([], 0)


@pytest.mark.parametrize(
    "fault, clock, message",
    [
        (Faults(cable_out=3), True, "pulse 3: 3 exposures to 6 pulses: the camera's trigger cable"),
        (Faults(strobe_out=True), True, "0 exposures were counted for 6 frames: check the strobe cable"),
        (Faults(strobe_out=True), False, "0 exposures were counted for 6 frames: check the strobe cable"),
        (Faults(lost_strobe=(2,)), False, "pulse 2: 5 exposures were counted for 6 frames: check the strobe cable"),
        (Faults(lost_trigger=(1, 3, 5)), True, "pulse 1: the camera misses pulses regularly (3 exposures to 6)"),
        (Faults(lost_trigger=(2,), noise=((2, 0.5),)), False, "pulse 2: its exposure is off by 0.50 periods: no"),
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
