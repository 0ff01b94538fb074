"""All files of a session, validated one by one, and whether the parts of a run are continuous."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from flowrec.core import Coverage, Ended, Outcome, Role, seconds, shell_word
from flowrec.store import UrlPath, continuity_fault, is_continued, part_number, part_path, size_of, verify_file
from flowrec.verbs.check_file import EXACT, HEAD, NOT_EXACT, FileCheck
from flowrec.verbs.verdict import CONSISTENT, DAMAGED, CheckFinding, Gap, Verdict


def check_session(
    path: Path, files: Sequence[Path], progress: Callable[[int], None], signers: Path | None = None
) -> Verdict:
    """The verdict on the files of a session; parameters and errors as of `flowrec.check`."""
    total = sum(map(size_of, files))
    checks: list[FileCheck] = []

    def read_bytes() -> int:
        return sum(check.read_bytes for check in checks)

    for file in files:
        check = FileCheck(file, lambda: progress(read_bytes()))
        checks.append(check)
        try:
            check.read()
        except KeyboardInterrupt as error:
            ended = Ended.of(error)
            covered = Coverage(read_bytes(), total, "bytes", stopped=ended.why, status=ended.status)
            ended.result = _verdict_so_far(path, covered, checks)
            raise ended from error
        _check_signature(check.verdict, signers)
    verdict = checks[0].verdict if list(files) == [path] else _check_run(path, checks)
    verdict.covered = Coverage(read_bytes(), total, "bytes", topics=tuple(verdict.topics))
    if all(check.found.header is not None for check in checks):
        verdict.covered = replace(verdict.covered, head=HEAD)
    amount, topics = verdict.covered.amount, len(verdict.topics)
    verdict.fact("covered", f"{amount}, {topics} topics, {', '.join(verdict.covered.head) or 'no head'}")
    return verdict


def _check_signature(verdict: Verdict, signers: Path | None) -> None:
    """Add what the signature beside a file says of it."""
    if isinstance(verdict.path, UrlPath):
        return
    found = verify_file(verdict.path, signers)
    if found is None:
        if signers is not None:
            verdict.fact("signature", "none")
    elif found.fault:
        verdict.bad("signature", f"{DAMAGED}: the signature beside it is not of this content ({found.fault})")
        verdict.integrity = f"{DAMAGED} since it was signed"
    elif found.signer:
        verdict.fact("signature", f"of {found.signer}, with {found.key}")
        if verdict.integrity == CONSISTENT:
            verdict.integrity = f"intact, signed by {found.signer}"
    elif signers is not None:
        verdict.odd("signature", f"made with {found.key}, which {signers} does not name as one to be trusted")
    else:
        verdict.fact("signature", f"with {found.key}; --signers FILE tells whose it is")


def _verdict_so_far(path: Path, covered: Coverage, checks: Sequence[FileCheck]) -> Verdict:
    """Verdict on the bytes that were read before a signal."""
    verdict = Verdict(path, covered)
    for check in checks:
        check.undecodable(verdict)
        check.not_finite(verdict)
        for topic, count in check.topics.items():
            verdict.topics[topic] = verdict.topics.get(topic, 0) + count
    return verdict


def _check_run(path: Path, checks: Sequence[FileCheck]) -> Verdict:
    """The verdict on all parts of a run together."""
    parts = [check.verdict for check in checks]
    run = Verdict(path, parts[0].covered, parts=parts)
    if len({part.integrity for part in parts}) == 1:
        run.integrity = parts[0].integrity
    else:
        apart = next(part for part in parts if part.integrity != CONSISTENT)
        run.integrity = f"{apart.path.name} is {apart.integrity}"
    first_ns, last = checks[0].found.first_ns, checks[-1].found
    parts_with: dict[CheckFinding, list[int]] = {}
    counts = Counter[str]()
    for check, part in zip(checks, parts, strict=True):
        for finding in part.findings:
            parts_with.setdefault(finding, []).append(part_number(part.path))
        run.gap_count += part.gap_count
        later_s = seconds(check.found.first_ns - first_ns)
        run.gaps += [Gap(gap.at_s + later_s, gap.length_s) for gap in part.gaps]
        counts.update(check.found.counts)
        counts.subtract(check.tally.repeated)
    for finding, numbers in parts_with.items():
        which = f"part {numbers[0]}" if len(numbers) == 1 else f"{len(numbers)} of {len(checks)} parts"
        run.findings.append(replace(finding, text=f"{which}: {finding.text}"))
    _check_continuity(run, checks)
    if last.finished and is_continued(last.outcome):
        following = part_path(path, part_number(last.path) + 1).name
        run.bad(
            "end",
            f"the run continues in {following}, which is missing; `flowrec recover {shell_word(path)}` ends it there",
        )
    known = {name: topic.path for check in checks for name, topic in check.found.topics.by_field.items()}
    run.topics = {known[name]: count for name, count in counts.items() if count}
    ticks, size_bytes = sum(check.tally.ticks for check in checks), sum(check.found.size_bytes for check in checks)
    duration_s = seconds(last.last_ns - first_ns)
    messages, frames = counts.total(), counts["frame"]
    run.figures = {key: parts[-1].figures.get(key) for key in ("outcome", "note")} | {
        "messages": messages,
        "size_bytes": size_bytes,
        "duration_s": duration_s,
        "ticks": ticks,
        "frames": frames,
    }
    run.fact("outcome", parts[-1].facts["outcome"])
    run.fact("content", f"{messages} messages on {len(run.topics)} topics in {size_bytes / 1e6:.1f} MB")
    run.fact("length", f"{duration_s:.2f} s, {ticks} ticks")
    run.fact("images", f"{frames} for {ticks} ticks")
    exact = all(part.facts["replay"].startswith(EXACT) for part in parts)
    run.fact("replay", "no" if run.word == "bad" else "yes; each part alone, too" if exact else NOT_EXACT)
    return run


def _check_continuity(run: Verdict, checks: Sequence[FileCheck]) -> None:
    """Report each part that is missing or does not begin where the one before ends."""
    before: FileCheck | None = None
    number = 0
    for check in checks:
        number += 1
        while number < part_number(check.found.path):
            run.bad("parts", f"part {number} is missing; the others can be read one by one")
            number, before = number + 1, None
        if check.found.header is None:  # already reported
            before = None
            continue
        fault = continuity_fault(check.found.run_file, number, before.found.run_file if before is not None else None)
        if fault is not None and (before is not None or number == 1):
            run.bad("parts", f"part {number} {fault}")
        elif before is not None:
            _compare_ends(run, f"part {number}", before, check)
        before = check
    if not any(finding.about == "parts" for finding in run.findings):
        run.fact("parts", f"{len(checks)}, each begins where the part before ends")


def _compare_ends(run: Verdict, name: str, before: FileCheck, after: FileCheck) -> None:
    """Compare the header and the keyframe of a part with what the part before ended with."""
    was, now = before.found.header, after.found.header
    assert was is not None and now is not None
    if not was.is_same_run(now):
        run.bad("parts", f"{name} has another header (configuration, chip or provenance) than the part before")
    outcome = before.found.outcome
    if before.found.finished and not is_continued(outcome) and outcome.get("outcome") != Outcome.CUT:
        run.odd("parts", f"{name} exists although the run ended with the part before")
    # A dropped image may be in only one of the parts; no stage reads truth and timing.
    known = after.found.topics
    read = {topic.field for topic in known.topics if topic.role in (Role.INPUT, Role.OUTPUT)} - {"frame"}
    differ = [
        known.by_field[key].path for key in read if before.tally.latest_ns.get(key) != after.tally.repeated_ns.get(key)
    ]
    if differ:
        run.odd("parts", f"{name} repeats other messages than the part before ended with: {', '.join(sorted(differ))}")
