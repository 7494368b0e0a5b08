#!/usr/bin/env bash
# Builds the native solvers with AddressSanitizer and UndefinedBehaviorSanitizer and runs them on random crowds.
set -euo pipefail
cd "$(dirname "$0")/../.."
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
sources=$(ls experts/native/*.cpp | grep -v bindings.cpp)
# shellcheck disable=SC2086
"${CXX:-c++}" -std=c++20 -O1 -g -Wall -Wextra -fsanitize=address,undefined -fno-sanitize-recover=all -D_GLIBCXX_ASSERTIONS \
    -I. $sources tests/native/fuzz_solvers.cpp -o "$build/fuzz" -pthread
"$build/fuzz" "${1:-300}" "${2:-0}"
