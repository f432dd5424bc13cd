"""What the tests in the machine report, line by line, while they run.

The lines come through the share as `guest/conftest.py` writes them: {"part", "event": "start" | "end" |
"over", "test", "outcome", "seconds", "detail"}. What the machine did not live to report is a failure too.
"""

import json

_FILE = "events.jsonl"
_LOGS = ("stack.log", "output.log")


class Events:
    """The reports of all runs of the machine."""

    def __init__(self, share):
        self.results = []
        self._share = share
        self._path = share / _FILE
        for old in (_FILE, *_LOGS):
            (share / old).unlink(missing_ok=True)
        self._read = 0
        self._running = {}
        self._over = set()

    def show(self, say):
        """Reads what is new and says it."""
        if not self._path.exists():
            return
        with self._path.open() as lines:
            lines.seek(self._read)
            while (line := lines.readline()).endswith("\n"):
                self._read = lines.tell()
                self._take(json.loads(line), say)

    def _take(self, event, say):
        part = event["part"]
        if event["event"] == "start":
            self._running[part] = event["test"]
        elif event["event"] == "over":
            self._over.add(part)
            if part in self._running:
                self._add(part, self._running.pop(part), "failed", 0.0, self._output(), say)
            elif event["code"] not in (0, 1) and not self._has_failed(part):
                self._add(part, part, "failed", 0.0, self._output(), say)
        else:
            self._running.pop(part, None)
            self._add(part, event["test"], event["outcome"], event["seconds"], event["detail"], say)

    def _add(self, part, test, outcome, seconds, detail, say=lambda *_, **__: None):
        result = {"part": part, "test": test, "outcome": outcome, "seconds": seconds, "detail": detail}
        self.results.append(result)
        say(f"{outcome:>8} {seconds:5.1f} s  {part}: {test}", flush=True)
        if outcome == "skipped":
            say(f"         {detail}", flush=True)

    def _has_failed(self, part):
        return any(result["part"] == part and result["outcome"] == "failed" for result in self.results)

    def _output(self):
        """Where the last test was when its time was over, and the last lines of all that was printed."""
        files = [self._share / name for name in _LOGS]
        texts = [path.read_text(errors="replace") for path in files if path.exists()]
        return "\n".join("\n".join(text.splitlines()[-40:]) for text in texts)

    def close_run(self, parts, outcome):
        """The parts that are still to be run after a run of the machine.

        The part in which the machine ended before its time is not tried again.
        """
        left = [part for part in parts if part not in self._over]
        if outcome.over and not left:
            return []
        guilty = left[0]
        self._add(guilty, self._running.pop(guilty, guilty), "failed", outcome.seconds, outcome.trouble)
        return left[1:]

    def lost(self, parts, why):
        """Parts that were not run."""
        for part in parts:
            self._add(part, part, "failed", 0.0, why)

    def summary(self, say, seconds):
        """Says what failed and why, and how it all went; the exit code."""
        counts = dict.fromkeys(("passed", "failed", "skipped"), 0)
        for result in self.results:
            counts[result["outcome"]] += 1
            if result["outcome"] == "failed":
                say(f"\n===== {result['part']}: {result['test']}\n{result['detail']}")
        told = ", ".join(f"{number} {outcome}" for outcome, number in counts.items())
        say(f"\n{told}, {seconds:.0f} s")
        return 1 if counts["failed"] or not counts["passed"] else 0
