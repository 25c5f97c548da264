#!/usr/bin/env bash
# Makes the pictures of the README from a real run: a full ladder, about three minutes on two cores.
# Needs a Vulkan driver (apt-get install mesa-vulkan-drivers) for the recording's picture.
set -euo pipefail
cd "$(dirname "$0")/.."

run=runs/ladder  # the picture shows the path: no folder of this machine, and not there yet
python3 start.py ladder --run-dir "$run" --seed 0
mkdir -p docs
python3 start.py view "$run" --screenshot docs/ladder.png
cp "$run/figures/learning.png" docs/
python3 start.py video "$run" --rollouts q-table-diffdrive --speed 8 --size 400 300 --output docs/robot.gif
