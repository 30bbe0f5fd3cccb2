"""Is an episode fit to train on? Timing, joints, pictures and touch, each judged by pure functions on its arrays.

An **error** says that the data is wrong: ingest quarantines the episode. A **warning** should be looked at. A **note** is
information; a check that could not be made is a note. ``finding.CHECKS`` lists all checks. They are in ``joint_checks`` (with
commands), ``picture_checks``, ``touch_checks`` (a pad by itself) and ``grip_checks`` (pads against grippers).
"""

from collections.abc import Iterable, Iterator

import numpy as np

from taccorl.data.episode import ChannelTiming, Episode
from taccorl.data.finding import Finding, finding, listed, not_judged
from taccorl.data.grip_checks import (
    DRIFT_SHARE,
    Grippers,
    check_touch_and_grip,
    odd_lags,
    read_grippers,
    rest_level,
)
from taccorl.data.grip_checks import touch_lags as lags_of_pad
from taccorl.data.joint_checks import Motion, arm_lags, check_motion, check_values
from taccorl.data.picture_checks import check_pictures
from taccorl.data.relative_checks import (
    RestingLevels,
    check_relative_motion,
    check_relative_touch,
)
from taccorl.data.spec import ACTION, STATE
from taccorl.data.touch_checks import (
    Pad,
    check_other_touch,
    check_pads,
    other_touch_keys,
    read_pads,
    tactile_keys,
)


def check_episode(episode: Episode, *, pictures: bool = True) -> list[Finding]:
    """All findings on one episode, worst first. ``pictures``: also decode the pictures, to find frozen ones."""
    if not episode.arrays or episode.num_rows < 2:
        return [not_judged("", "episode", "it has less than two rows of numbers")]
    findings = [
        *episode.findings,
        *(f for timing in episode.timing for f in check_timing(timing, episode)),
    ]
    values = list(check_values(episode))
    wrong, keys = {f.feature for f in values}, tactile_keys(episode)
    touch = [
        pad.mean(axis=(1, 2)) for key in keys for pad in episode.pads(key).values()
    ]
    no_touch = np.empty((episode.num_rows, 0))
    findings += values
    findings += check_motion(
        Motion(episode, wrong), np.stack(touch, axis=1) if touch else no_touch
    )
    known = {(f.check, f.feature) for f in findings}
    findings += [
        f
        for f in check_relative_motion(episode)
        if (f.check, f.feature) not in known and f.feature not in wrong
    ]
    joints_wrong = wrong & {STATE, ACTION} or any(
        f.check == "swapped_arms" for f in findings
    )
    for key in keys:
        if key not in wrong:
            findings += check_pads(episode, key, pads := read_pads(episode, key))
            why = not_judged(
                key, "touch against grippers", "joints or command are wrong"
            )
            findings += (
                [why] if joints_wrong else check_touch_and_grip(episode, key, pads)
            )
    for key in other_touch_keys(episode):
        findings += check_other_touch(episode, key)
        findings += check_relative_touch(episode, key)
    findings += check_pictures(episode, decode=pictures)
    return sorted(
        findings, key=lambda f: ("error", "warning", "note").index(f.severity)
    )


RATE_SHARE = 0.8
"""Lowest accepted rate, as a share of the stated one: every fifth sample lost, or the driver set wrongly."""
GAP_S = 0.1  # Shortest interval between two samples that is a gap [s]: three rows at 30 fps with an old sample
GAPS_SHARE = 0.05  # Highest accepted share of dropped samples; recordings of leggedrobotics tolerate 5 %
GAPS_MIN = 3  # Fewest gaps that are reported: fewer are single samples, even if a large share of a short episode
OLD_SAMPLES_PERIODS = 1.5  # Highest accepted median age of samples [periods]: half is usual, one the worst case


def check_timing(t: ChannelTiming, episode: Episode) -> Iterator[Finding]:
    """Check the timing of one channel: rate, gaps, and age of its samples at the rows."""
    promised_hz = t.nominal_hz or episode.spec.features[t.feature].rate_hz
    samples, found = max(t.rate_hz * episode.num_rows / episode.spec.fps, 1.0), []
    if t.align != "hold":  # a command may come only when it changes
        if t.rate_hz < RATE_SHARE * promised_hz:
            text = f"{t.rate_hz:.1f} Hz, the data spec says {promised_hz:g} Hz: a loaded host, a slower mode, or the "
            found.append(("low_rate", f"{text}spec"))
        if t.longest_gap_s > GAP_S or t.gaps >= max(GAPS_MIN, GAPS_SHARE * samples):
            text = f"{t.gaps} gaps in about {samples:.0f} samples, longest {t.longest_gap_s * 1000:.0f} ms (limits: "
            text += f"{GAPS_SHARE:.0%}, {GAP_S * 1000:.0f} ms): samples were dropped; look at the recorder's disk and "
            found.append(("gaps", f"{text}USB load"))
        if t.age_median_s > OLD_SAMPLES_PERIODS / promised_hz:
            text = f"rows show samples {t.age_median_s * 1000:.0f} ms old (median), {t.age_max_s * 1000:.0f} ms at "
            text += f"worst; a period is {1000 / promised_hz:.0f} ms: a clock that is behind"
            found.append(("old_samples", f"{text}, set `latency_s` or `clock`"))
    for (
        name,
        number,
        what,
    ) in (  # counted over the whole recording, which may hold many episodes
        (
            "duplicates",
            t.duplicates,
            "samples of the recording repeat a stamp; the first of each was kept",
        ),
        (
            "out_of_order",
            t.out_of_order,
            "samples of the recording were out of order; sorted by stamp",
        ),
        (
            "zero_stamps",
            t.zero_stamps,
            "samples of the recording are stamped 0; left out (`drop_zero_stamp`)",
        ),
        *(
            ("skipped", n, f"messages of the recording give no sample: {why}")
            for why, n in t.skipped.items()
        ),
    ):
        found += [(name, f"{number} {what}")] if number else []
    yield from (
        finding(name, t.channel, f"{t.channel} ({t.feature}): {text}")
        for name, text in found
    )


# ---- across the episodes of a recording ----

EPISODE_LAG_S = 0.05  # Largest difference of an episode's lag from its recording's median [s]: 1.5 rows at 30 fps
COMPARED_EPISODES = 3  # Least number of episodes for deciding which one differs


def check_recording_episodes(episodes: Iterable[Episode]) -> list[Finding]:
    """Compare the episodes of one recording; each finding names the episode that differs. Of an episode only what is compared is
    kept, so that ``episodes`` may be read one by one."""
    across = _Across()
    for episode in episodes:
        across.add(episode)
    return across.findings()


class _Across:
    """What is compared between episodes: lags of arms and pads, and levels of untouched pads. All by name of feature, pad or
    arm, and of episode."""

    def __init__(self) -> None:
        self.num_episodes = 0
        self.arm_lags: dict[str, dict[str, float]] = {}
        self.pad_lags: dict[str, dict[str, list[float]]] = {}
        self.levels: dict[str, dict[str, dict[float, str]]] = {}
        self.limits: dict[str, float] = {}
        """Key of touch → largest difference between levels of rest [counts]."""
        self.other_touch: dict[str, RestingLevels] = {}

    def add(self, episode: Episode) -> None:
        """Add an episode, unless its values are wrong."""
        self.num_episodes += 1
        for key in other_touch_keys(episode):
            levels = self.other_touch.setdefault(key, RestingLevels())
            levels.add(episode.name, episode.arrays[key], episode.spec.fps)
        if not episode.arrays or episode.num_rows < 2 or any(check_values(episode)):
            return
        for arm, lag in arm_lags(episode).items():
            self.arm_lags.setdefault(arm, {})[episode.name] = lag.lag_s
        if (grippers := read_grippers(episode)) is None:
            return
        for key in tactile_keys(episode):
            self.limits[key] = DRIFT_SHARE * episode.spec.sensors[key].noise_count
            for pad in read_pads(episode, key):
                if pad.arm in grippers.opening:
                    self._add_pad(episode, key, pad, grippers)

    def _add_pad(
        self, episode: Episode, key: str, pad: Pad, grippers: Grippers
    ) -> None:
        lags = self.pad_lags.setdefault(key, {}).setdefault(pad.name, [])
        lags += lags_of_pad(pad, grippers, episode.spec.fps)
        level = rest_level(pad.counts, grippers.rest(pad.arm, pad.fps), pad.fps)
        levels = self.levels.setdefault(key, {}).setdefault(pad.name, {})
        if level is not None:
            levels.setdefault(level, episode.name)

    def findings(self) -> list[Finding]:
        """Findings of all episodes together; of a single one only its levels of rest."""
        resting = [
            found
            for key, levels in self.other_touch.items()
            for found in levels.finding(key)
        ]
        if self.num_episodes < 2:
            return resting
        return [
            *resting,
            *_odd_arms(self.arm_lags),
            *_odd_touch(self.pad_lags),
            *_resting_levels(self.levels, self.limits),
        ]


def _odd_arms(lags: dict[str, dict[str, float]]) -> Iterator[Finding]:
    for arm, of_arm in lags.items():
        for name, lag_s in of_arm.items() if len(of_arm) >= COMPARED_EPISODES else ():
            others = float(np.median([x for n, x in of_arm.items() if n != name]))
            if abs(lag_s - others) > EPISODE_LAG_S:
                text = f"{name}: the {arm or 'only'} arm follows its command after {lag_s:.3f} s, in the other "
                text += f"{len(of_arm) - 1} episodes after {others:.3f} s. It may be a stepped clock, other gains, or another "
                text += "kind of motion (a joint follows steps later than slow sweeps)"
                yield finding("action_lag", ACTION, text)


def _odd_touch(lags: dict[str, dict[str, list[float]]]) -> Iterator[Finding]:
    """Many holds average out the resolution of one row, so the accepted interval is not widened by it."""
    for key, of_pads in sorted(lags.items()):
        odd, text = odd_lags(of_pads, least=2)
        if odd:
            text = f"in all episodes together, {text}: set `clock` or `latency_s` on these pads' channels"
            yield finding("touch_lag", key, text)


def _resting_levels(
    levels: dict[str, dict[str, dict[float, str]]], limits: dict[str, float]
) -> Iterator[Finding]:
    """Pads that rest at another level in a later episode: one baseline for the whole recording no longer holds."""
    for key, of_pads in levels.items():
        ends = {
            pad: (min(of_pad), max(of_pad), of_pad)
            for pad, of_pad in of_pads.items()
            if of_pad
        }
        drifting = [
            f"{pad} {low:+.1f} counts in {of_pad[low]}, {high:+.1f} in {of_pad[high]}"
            for pad, (low, high, of_pad) in ends.items()
            if high - low > limits[key]
        ]
        if drifting:
            text = f"untouched taxels rest at different levels: {listed(drifting)} (limit {limits[key]:g} counts "
            text += "apart, a third of noise_count): record shorter, or take a new baseline in between"
            yield finding("baseline_drift", key, text)
