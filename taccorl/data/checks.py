"""Is an episode fit to train on? Timing, joints, pictures and touch, each judged by pure functions on its arrays.

An **error** says that the data is wrong: ingest quarantines the episode. A **warning** should be looked at. A **note** is
information; a check that could not be made is reported as a note.

    error    not_finite, joint_limit, out_of_range, swapped_arms, swapped_pads, noise_only,
             action_lag (command after state), frozen_picture (half of the episode or more),
             touch_lag (too early on one arm and too late on the other)
    warning  dead_command, frozen_command, copied_command, command_scale, unexplained_motion, low_rate, gaps, old_samples, jump,
             sample_jump (between a channel's own samples), idle, frozen_state, frozen_picture, action_lag (too long, or not as
             the other arm's or episodes'), dead_taxel, stuck_taxel, saturated, noisy_pad, frozen_touch, silent_pad, touch_lag,
             pad_lag, baseline_drift, baseline_offset
    note     duplicates, out_of_order, zero_stamps, skipped, saturated (a few rows), contact_coverage, not_judged

The parts are in ``joint_checks``, ``command_checks`` and ``lag_checks`` (state against command), ``picture_checks``,
``touch_checks`` (a pad by itself) and ``grip_checks`` (pads against grippers). Thresholds stand there, with unit and reason.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from taccorl.data import command_checks, joint_checks, lag_checks
from taccorl.data.arms import ACTION, STATE, episode_arms
from taccorl.data.episode import ChannelTiming, Episode
from taccorl.data.finding import Finding, Severity, listed, not_judged
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
from taccorl.data.touch_checks import Pad, check_other_touch, check_pads, other_touch_keys, read_pads, tactile_keys

__all__ = ["Finding", "Severity", "check_episode", "check_recording_episodes"]

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
    """Return all findings on one episode, worst first.

    Args:
        pictures: also decode the pictures, to find frozen ones.
    """
    if not episode.arrays or episode.num_rows < 2:
        return [not_judged("", "episode", "it has less than two rows of numbers")]
    findings = [*episode.findings, *(f for timing in episode.timing for f in check_timing(timing, episode))]
    values = joint_checks.check_values(episode)
    wrong = {f.feature for f in values}
    findings += values + _check_motion(episode, wrong)
    joints_fit = not wrong & {STATE, ACTION} and not any(f.check == "swapped_arms" for f in findings)
    for key in tactile_keys(episode):
        findings += _check_touch(episode, key, joints_fit) if key not in wrong else []
    findings += [f for key in other_touch_keys(episode) for f in check_other_touch(episode, key)]
    findings += check_pictures(episode, decode=pictures)
    return sorted(findings, key=lambda f: ("error", "warning", "note").index(f.severity))


def _check_motion(episode: Episode, wrong: set[str]) -> list[Finding]:
    findings: list[Finding] = []
    vectors = [key for key in (STATE, ACTION) if key in episode.arrays]
    for key in vectors:
        if key not in wrong:
            findings += joint_checks.check_jumps(episode, key)
    if vectors and not wrong & set(vectors):
        pads = [pad for key in tactile_keys(episode) for pad in episode.pads(key).values()]
        touch = np.stack([p.mean(axis=(1, 2)) for p in pads], axis=1) if pads else np.empty((episode.num_rows, 0))
        findings += joint_checks.check_idle(episode, touch)
    if not all(np.isfinite(episode.arrays[key]).all() for key in vectors):
        return [*findings, not_judged(ACTION, "action lag, swapped arms", "values that are not finite")]
    findings += (commands := command_checks.check_commands(episode))
    arms = episode_arms(episode)
    if not any(len(arm.joints) for arm in arms):
        return [*findings, not_judged(ACTION, "action lag, swapped arms", "no joints in rad named alike in both")]
    swapped = lag_checks.check_swapped_arms(episode)
    findings += swapped
    if not any(f.severity == "error" for f in swapped):
        findings += lag_checks.check_lag(episode, explained=bool(commands))
        findings += [f for arm in arms for f in joint_checks.check_frozen_state(episode, arm)]
    return findings


def _check_touch(episode: Episode, key: str, joints_fit: bool) -> list[Finding]:
    pads = read_pads(episode, key)
    findings = check_pads(episode, key, pads)
    grippers = read_grippers(episode) if joints_fit else None
    if grippers is None:
        why = (
            "state and action have no number in m that is named `gripper`"
            if joints_fit
            else "joints or command are wrong"
        )
        return [*findings, not_judged(key, "touch against grippers", why)]
    return findings + check_touch_and_grip(episode, key, pads, grippers)


def check_timing(timing: ChannelTiming, episode: Episode) -> list[Finding]:
    """Check the timing of one channel: rate, gaps, and age of its samples at the rows. Returns findings, none if all is well."""
    duration_s = episode.num_rows / episode.spec.fps
    promised_hz = timing.nominal_hz or episode.spec.features[timing.feature].rate_hz
    samples = max(timing.rate_hz * duration_s, 1.0)
    findings: list[Finding] = []

    def add(check: str, severity: Severity, text: str) -> None:
        findings.append(Finding(check, severity, timing.channel, f"{timing.channel} ({timing.feature}): {text}"))

    if timing.align != "hold":  # a command may come only when it changes
        if timing.rate_hz < RATE_SHARE * promised_hz:
            add(
                "low_rate",
                "warning",
                f"{timing.rate_hz:.1f} Hz, the data spec says {promised_hz:g} Hz: a loaded host, a slower mode, or the spec",
            )
        if timing.longest_gap_s > GAP_S or timing.gaps >= max(GAPS_MIN, GAPS_SHARE * samples):
            add(
                "gaps",
                "warning",
                f"{timing.gaps} gaps in about {samples:.0f} samples, longest {timing.longest_gap_s * 1000:.0f} ms (limits: "
                f"{GAPS_SHARE:.0%}, {GAP_S * 1000:.0f} ms): samples were dropped; look at the recorder's disk and USB load",
            )
        if timing.age_median_s > OLD_SAMPLES_PERIODS / promised_hz:
            add(
                "old_samples",
                "warning",
                f"rows show samples {timing.age_median_s * 1000:.0f} ms old (median), {timing.age_max_s * 1000:.0f} ms at "
                f"worst; a period is {1000 / promised_hz:.0f} ms: a clock that is behind, set `latency_s` or `clock`",
            )
    # Counted over the whole recording, which may hold many episodes.
    for check, number, what in (
        ("duplicates", timing.duplicates, "samples of the recording repeat a stamp; the first of each was kept"),
        ("out_of_order", timing.out_of_order, "samples of the recording were out of order; sorted by stamp"),
        ("zero_stamps", timing.zero_stamps, "samples of the recording are stamped 0; left out (`drop_zero_stamp`)"),
        *(
            ("skipped", count, f"messages of the recording give no sample: {why}")
            for why, count in timing.skipped.items()
        ),
    ):
        if number:
            add(check, "note", f"{number} {what}")
    return findings


# ---- across the episodes of a recording ----


def check_recording_episodes(episodes: Sequence[Episode]) -> list[Finding]:
    """Compare the episodes of one recording with each other; returns findings, each of which names the episode that differs."""
    if len(episodes) < 2:
        return []
    good = [e for e in episodes if e.arrays and e.num_rows >= 2 and not joint_checks.check_values(e)]
    return [*_odd_lags(good), *_touch_lags(good), *_resting_levels(good)]


def _odd_lags(episodes: list[Episode]) -> list[Finding]:
    lags: dict[str, dict[str, float]] = {}
    for episode in episodes:
        for arm, lag in lag_checks.arm_lags(episode).items():
            lags.setdefault(arm, {})[episode.name] = lag.lag_s
    findings = []
    for arm, by_episode in lags.items():
        if len(by_episode) < COMPARED_EPISODES:
            continue
        for name, lag_s in by_episode.items():
            others = float(np.median([x for n, x in by_episode.items() if n != name]))
            if abs(lag_s - others) > EPISODE_LAG_S:
                findings.append(
                    Finding(
                        "action_lag",
                        "warning",
                        ACTION,
                        f"{name}: the {arm or 'only'} arm follows its command after {lag_s:.3f} s, in the other "
                        f"{len(by_episode) - 1} episodes after {others:.3f} s: a clock stepped in this recording",
                    )
                )
    return findings


def _pads_and_grippers(episodes: list[Episode]) -> Iterator[tuple[Episode, str, list[Pad], Grippers]]:
    """Per episode and tactile feature: the pads that belong to a gripper, and the grippers."""
    for episode in episodes:
        grippers = read_grippers(episode)
        if grippers is not None:
            for key in tactile_keys(episode):
                yield episode, key, [pad for pad in read_pads(episode, key) if pad.arm in grippers.opening], grippers


def _touch_lags(episodes: list[Episode]) -> list[Finding]:
    """Touch lags of all holds together. Many holds average out the resolution of one row, so the accepted interval is not
    widened by it."""
    lags: dict[tuple[str, str], list[float]] = {}
    for episode, key, pads, grippers in _pads_and_grippers(episodes):
        for pad in pads:
            lags.setdefault((key, pad.name), []).extend(touch_lags(pad, grippers, episode.spec.fps))
    low, high = TOUCH_LAG_S
    findings = []
    for key in sorted({key for key, _ in lags}):
        medians = {pad: float(np.median(found)) for (k, pad), found in lags.items() if k == key and len(found) > 1}
        odd = {pad: lag for pad, lag in medians.items() if not low <= lag <= high}
        if odd:
            each = ", ".join(f"{pad} {lag_text(lag)}" for pad, lag in odd.items())
            findings.append(
                Finding(
                    "touch_lag",
                    "warning",
                    key,
                    f"in all episodes together, pads first feel the part at odd times from the gripper's stop on it: {each} "
                    f"(medians; plausible {low:g} to {high:g} s): set `clock` or `latency_s` on these pads' channels",
                )
            )
    return findings


def _resting_levels(episodes: list[Episode]) -> list[Finding]:
    """Pads that rest at another level in a later episode: one baseline for the whole recording no longer holds."""
    levels: dict[tuple[str, str], dict[str, float]] = {}
    limits: dict[str, float] = {}
    for episode, key, pads, grippers in _pads_and_grippers(episodes):
        limits[key] = DRIFT_SHARE * episode.spec.sensors[key].noise_count
        for pad in pads:
            level = rest_level(pad.counts, grippers.rest(pad.arm, episode.spec.fps), episode.spec.fps)
            if level is not None:
                levels.setdefault((key, pad.name), {})[episode.name] = level
    findings = []
    for key, limit in limits.items():
        drifting = []
        for (k, pad), level in levels.items():
            low, high = min(level, key=level.__getitem__), max(level, key=level.__getitem__)
            if k == key and level[high] - level[low] > limit:
                drifting.append(f"{pad} {level[low]:+.1f} counts in {low}, {level[high]:+.1f} in {high}")
        if drifting:
            findings.append(
                Finding(
                    "baseline_drift",
                    "warning",
                    key,
                    f"untouched taxels rest at different levels: {listed(drifting)} (limit {limit:g} counts apart, a third "
                    f"of noise_count): record shorter, or take a new baseline in between",
                )
            )
    return findings
