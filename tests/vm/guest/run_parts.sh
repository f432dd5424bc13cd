#!/bin/sh
# In the machine: each part in a process of its own, so that one that dies does not take the others with it.
# The configuration is the project's, with names of files that the ordinary tests do not look for.
for part in "$@"; do
    PART="$part" "$PYTHON" -m pytest -q -p no:cacheprovider --confcutdir=tests/vm/guest \
        -o python_files='check_*.py' -o addopts='--import-mode=importlib --strict-markers' \
        "tests/vm/guest/check_$part.py"
    echo "{\"part\": \"$part\", \"event\": \"over\", \"code\": $?}" >> /run/machine/share/events.jsonl
done
dmesg > /run/machine/share/dmesg.log 2> /dev/null || /run/machine/busybox dmesg > /run/machine/share/dmesg.log
