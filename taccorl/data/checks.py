"""Is an episode fit to train on? Timing, joints, pictures and touch, each judged by pure functions on its arrays.

An **error** says that the data is wrong: ingest quarantines the episode. A **warning** should be looked at. A **note** is
information; a check that could not be made is reported as a note. ``finding.CHECKS`` lists all checks. They are in
``joint_checks``, ``command_checks`` (state against command), ``picture_checks``, ``touch_checks`` (a pad by itself) and
``grip_checks`` (pads against grippers).
"""

from collections.abc import Iterator, Sequence

import numpy as np

from taccorl.data import command_checks, joint_checks
from taccorl.data.episode import ChannelTiming, Episode
from taccorl.data.finding import Finding, finding, listed, not_judged
from taccorl.data.grip_checks import (
    DRIFT_SHARE,
    TOUCH_LAG_S,
    Grippers,
    check_touch_and_grip,
    lag_text,
    read_grippers,
    rest_level,
    touch_lags,
)
from taccorl.data.picture_checks import check_pictures
from taccorl.data.spec import ACTION, STATE
from taccorl.data.touch_checks import Pad, check_other_touch, check_pads, other_touch_keys, read_pads, tactile_keys

RATE_SHARE = 0.8
"""Lowest accepted rate of a channel, as a share of the rate that the spec states: below it every fifth sample is lost, or the
driver is set up wrongly."""
GAP_S = 0.1
"""Shortest interval between two samples that is reported as a gap [s]: three rows at 30 fps, during which a policy would see an
old sample."""
GAPS_SHARE = 0.05
"""Highest accepted share of dropped samples of a channel. Recordings of leggedrobotics tolerate 5 %."""
GAPS_MIN = 3
"""Least number of gaps that is reported: fewer are single dropped samples, even if they are a large share of a short episode."""
OLD_SAMPLES_PERIODS = 1.5
"""Highest accepted median age of the samples in the rows, in periods of the channel: half a period is usual, one period the
worst case."""
EPISODE_LAG_S = 0.05
"""Largest accepted difference [s] between the lag of one episode and the median lag of its recording: a row and a half at 30
fps."""
COMPARED_EPISODES = 3  # Least number of episodes in a recording for deciding which one differs


def check_episode(episode: Episode, *, pictures: bool = True) -> list[Finding]:
    """Return all findings on one episode, worst first. ``pictures``: also decode the pictures, to find frozen ones."""
    if not episode.arrays or episode.num_rows < 2:
        return [not_judged("", "episode", "it has less than two rows of numbers")]
    findings = [*episode.findings, *(f for timing in episode.timing for f in check_timing(timing, episode))]
    values = list(joint_checks.check_values(episode))
    wrong = {f.feature for f in values}
    findings += [*values, *_check_motion(episode, wrong)]
    joints_fit = not wrong & {STATE, ACTION} and not any(f.check == "swapped_arms" for f in findings)
    for key in tactile_keys(episode):
        findings += _check_touch(episode, key, joints_fit) if key not in wrong else []
    findings += [f for key in other_touch_keys(episode) for f in check_other_touch(episode, key)]
    findings += check_pictures(episode, decode=pictures)
    return sorted(findings, key=lambda f: ("error", "warning", "note").index(f.severity))


def _check_motion(episode: Episode, wrong: set[str]) -> Iterator[Finding]:
    """Findings on state and command, without those that another one explains."""
    vectors = [key for key in (STATE, ACTION) if key in episode.arrays]
    for key in vectors:
        if key not in wrong:
            yield from joint_checks.check_jumps(episode, key)
    if vectors and not wrong & set(vectors):
        pads = [pad for key in tactile_keys(episode) for pad in episode.pads(key).values()]
        touch = np.stack([p.mean(axis=(1, 2)) for p in pads], axis=1) if pads else np.empty((episode.num_rows, 0))
        yield from joint_checks.check_idle(episode, touch)
    if not all(np.isfinite(episode.arrays[key]).all() for key in vectors):
        yield not_judged(ACTION, "action lag, swapped arms", "values that are not finite")
        return
    commands = list(command_checks.check_commands(episode))
    yield from commands
    arms = episode.arms()
    if not any(len(arm.joints) for arm in arms):
        yield not_judged(ACTION, "action lag, swapped arms", "no joints in rad named alike in both")
        return
    swapped = list(command_checks.check_swapped_arms(episode))
    yield from swapped
    if not any(f.severity == "error" for f in swapped):
        yield from command_checks.check_lag(episode, explained=bool(commands))
        for arm in arms:
            yield from joint_checks.check_frozen_state(episode, arm)


def _check_touch(episode: Episode, key: str, joints_fit: bool) -> Iterator[Finding]:
    pads = read_pads(episode, key)
    yield from check_pads(episode, key, pads)
    if not joints_fit:
        yield not_judged(key, "touch against grippers", "joints or command are wrong")
    elif (grippers := read_grippers(episode)) is None:
        why = "state and action have no number in m that is named `gripper`"
        yield not_judged(key, "touch against grippers", why)
    else:
        yield from check_touch_and_grip(episode, key, pads, grippers)


def check_timing(timing: ChannelTiming, episode: Episode) -> Iterator[Finding]:
    """Check the timing of one channel: rate, gaps, and age of its samples at the rows."""
    duration_s = episode.num_rows / episode.spec.fps
    promised_hz = timing.nominal_hz or episode.spec.features[timing.feature].rate_hz
    samples = max(timing.rate_hz * duration_s, 1.0)
    found: list[tuple[str, str]] = []
    if timing.align != "hold":  # a command may come only when it changes
        if timing.rate_hz < RATE_SHARE * promised_hz:
            text = f"{timing.rate_hz:.1f} Hz, the data spec says {promised_hz:g} Hz: a loaded host, a slower mode, or the spec"
            found.append(("low_rate", text))
        if timing.longest_gap_s > GAP_S or timing.gaps >= max(GAPS_MIN, GAPS_SHARE * samples):
            text = (
                f"{timing.gaps} gaps in about {samples:.0f} samples, longest {timing.longest_gap_s * 1000:.0f} ms (limits: "
                f"{GAPS_SHARE:.0%}, {GAP_S * 1000:.0f} ms): samples were dropped; look at the recorder's disk and USB load"
            )
            found.append(("gaps", text))
        if timing.age_median_s > OLD_SAMPLES_PERIODS / promised_hz:
            text = (
                f"rows show samples {timing.age_median_s * 1000:.0f} ms old (median), {timing.age_max_s * 1000:.0f} ms at worst; "
                f"a period is {1000 / promised_hz:.0f} ms: a clock that is behind, set `latency_s` or `clock`"
            )
            found.append(("old_samples", text))
    # Counted over the whole recording, which may hold many episodes.
    for check, number, what in (
        ("duplicates", timing.duplicates, "samples of the recording repeat a stamp; the first of each was kept"),
        ("out_of_order", timing.out_of_order, "samples of the recording were out of order; sorted by stamp"),
        ("zero_stamps", timing.zero_stamps, "samples of the recording are stamped 0; left out (`drop_zero_stamp`)"),
        *(("skipped", n, f"messages of the recording give no sample: {why}") for why, n in timing.skipped.items()),
    ):
        if number:
            found.append((check, f"{number} {what}"))
    for check, text in found:
        yield finding(check, timing.channel, f"{timing.channel} ({timing.feature}): {text}")


# ---- across the episodes of a recording ----


def check_recording_episodes(episodes: Sequence[Episode]) -> list[Finding]:
    """Compare the episodes of one recording with each other; returns findings, each of which names the episode that differs."""
    if len(episodes) < 2:
        return []
    good = [e for e in episodes if e.arrays and e.num_rows >= 2 and not any(joint_checks.check_values(e))]
    return [*_odd_lags(good), *_touch_lags(good), *_resting_levels(good)]


def _odd_lags(episodes: list[Episode]) -> Iterator[Finding]:
    lags: dict[str, dict[str, float]] = {}
    for episode in episodes:
        for arm, lag in command_checks.arm_lags(episode).items():
            lags.setdefault(arm, {})[episode.name] = lag.lag_s
    for arm, by_episode in lags.items():
        for name, lag_s in by_episode.items() if len(by_episode) >= COMPARED_EPISODES else ():
            others = float(np.median([x for n, x in by_episode.items() if n != name]))
            if abs(lag_s - others) > EPISODE_LAG_S:
                text = (
                    f"{name}: the {arm or 'only'} arm follows its command after {lag_s:.3f} s, in the other "
                    f"{len(by_episode) - 1} episodes after {others:.3f} s: a clock stepped in this recording"
                )
                yield finding("action_lag", ACTION, text)


def _pads_and_grippers(episodes: list[Episode]) -> Iterator[tuple[Episode, str, list[Pad], Grippers]]:
    """Per episode and tactile feature: the pads that belong to a gripper, and the grippers."""
    for episode in episodes:
        grippers = read_grippers(episode)
        if grippers is not None:
            for key in tactile_keys(episode):
                yield episode, key, [pad for pad in read_pads(episode, key) if pad.arm in grippers.opening], grippers


def _touch_lags(episodes: list[Episode]) -> Iterator[Finding]:
    """Touch lags of all holds together. Many holds average out the resolution of one row, so the accepted interval is not
    widened by it."""
    lags: dict[str, dict[str, list[float]]] = {}
    for episode, key, pads, grippers in _pads_and_grippers(episodes):
        for pad in pads:
            lags.setdefault(key, {}).setdefault(pad.name, []).extend(touch_lags(pad, grippers, episode.spec.fps))
    low, high = TOUCH_LAG_S
    for key, by_pad in sorted(lags.items()):
        medians = {pad: float(np.median(found)) for pad, found in by_pad.items() if len(found) > 1}
        odd = [f"{pad} {lag_text(lag)}" for pad, lag in medians.items() if not low <= lag <= high]
        if odd:
            text = (
                f"in all episodes together, pads first feel the part at odd times from the gripper's stop on it: "
                f"{', '.join(odd)} (medians; plausible {low:g} to {high:g} s): set `clock` or `latency_s` on these pads' channels"
            )
            yield finding("touch_lag", key, text)


def _resting_levels(episodes: list[Episode]) -> Iterator[Finding]:
    """Pads that rest at another level in a later episode: one baseline for the whole recording no longer holds."""
    levels: dict[str, dict[str, dict[str, float]]] = {}
    limits: dict[str, float] = {}
    for episode, key, pads, grippers in _pads_and_grippers(episodes):
        limits[key] = DRIFT_SHARE * episode.spec.sensors[key].noise_count
        for pad in pads:
            level = rest_level(pad.counts, grippers.rest(pad.arm, episode.spec.fps), episode.spec.fps)
            if level is not None:
                levels.setdefault(key, {}).setdefault(pad.name, {})[episode.name] = level
    for key, by_pad in levels.items():
        drifting = []
        for pad, level in by_pad.items():
            low, high = min(level, key=level.__getitem__), max(level, key=level.__getitem__)
            if level[high] - level[low] > limits[key]:
                drifting.append(f"{pad} {level[low]:+.1f} counts in {low}, {level[high]:+.1f} in {high}")
        if drifting:
            text = (
                f"untouched taxels rest at different levels: {listed(drifting)} (limit {limits[key]:g} counts apart, a third of "
                "noise_count): record shorter, or take a new baseline in between"
            )
            yield finding("baseline_drift", key, text)
