# `just --list` shows the recipes. CI runs them too (.ci/run).
set shell := ["bash", "-euo", "pipefail", "-c"]
export OMP_NUM_THREADS := "1"        # more threads only compete for the cores
export OMP_WAIT_POLICY := "passive"

# formatting, lint, imports between the floors
lint:
    ruff format --check .
    ruff check .
    lint-imports

# mypy over the project and its tests
types:
    mypy

# the tests of the default run: side by side, then those that want the machine for themselves
test: (side-by-side "not slow and not containers and not network")

# what takes long: other instruction sets, faults, trainings, benchmarks
test-slow: (side-by-side "slow")

# one more than cores, as many tests wait for other processes: 6 minutes in place of 9 on two
[private]
side-by-side which:
    pytest -n $(({{num_cpus()}} + 1)) --dist loadfile -m "{{which}} and not alone"
    pytest -m "{{which}} and alone"

# what asks the package index
test-network:
    pytest -m network

# the site in build/site; every warning is an error
docs:
    python docs/messages.py
    python -m penumbra.shared.cell.reference docs/own-cell.md
    NO_MKDOCS_2_WARNING=1 mkdocs build --strict --quiet

# the tables of docs/results, from the benchmarks' JSON in docs/results/data
results:
    python -m penumbra.tests.bench.lib.published

# build and run the images; needs a Docker engine
containers:
    pytest -m containers tests/chain/test_compose.py

# compile the libraries of shared/native for all processors; needs the linkers that shared/native/build.py names
kernels:
    python -m penumbra.shared.native.build

# the Kubernetes manifests, from the table of processes
kubernetes:
    python docker/kubernetes/generate.py

# requirements.lock, the tested set of versions; `just lock --upgrade` takes the newest ones
lock *arguments:
    uv pip compile --quiet --universal --python-version 3.11 --all-extras --no-emit-index-url --no-emit-find-links \
        --custom-compile-command "just lock" {{arguments}} pyproject.toml -o requirements.lock
