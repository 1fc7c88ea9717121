#!/usr/bin/env bash
# benchmarks/gpu_curves.sh OUT: the curves of gpu.sh's pixel runs so far, in one file.
cd "$1/pixels" && for curve in $(find . -name curve.csv | sort); do sed "s|^|${curve%/curve.csv},|" "$curve"; done > ../pixels.csv
