"""What `relight doctor` looks at, part by part; each gives findings, and opens or changes only what it must.

finding.py      one line of the answer: well, worth knowing, wrong, not looked at; and what to do
machine.py      Python, libraries, system
permissions.py  device files that this user may not open, and the udev rules that change it
disk.py         free space and write speed
quirks.py       cameras and drivers that are known for something
devices.py      what is plugged in
rehearsal.py    a capture of a few seconds: do locks hold, when does the light come, does it band
"""
