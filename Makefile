# The front door: `make` alone lists what there is. Every target builds .venv first when it needs to.

PYTHON ?= python3
VENV := .venv
QRL := $(VENV)/bin/qrl
STAMP := $(VENV)/ready
CUDA := $(VENV)/cuda

.DEFAULT_GOAL := help
.PHONY: help setup train identify evaluate export view fly sweep seeds tasks figures ablation gallery bench gpu test smoke lint docs stress torture FORCE
.SUFFIXES:
MAKEFLAGS += --no-print-directory

define HELP
  make setup                         make .venv with the pinned dependencies
  make tasks                         list the tasks that TASK may name
  make train TASK=circle             train, and leave a run folder
       SEED=0 SEEDS=1                  the first seed; how many to train in one program
       VEHICLE=crazyflie               what flies it: a shipped name, or a .json of yours
       UNCERTAINTY=default             what differs from flight to flight: a shipped name, or a .json of yours
       OUT=runs/circle                 the run folder
       RESUME=1                        resume that run from its last checkpoint
       INIT=any                        begin with the policy of that run: fine-tune it
       CONFIG=f.json                   hyperparameters, or the config.json of a run to repeat
       ARGS="--gamma 0.97"             any other flag of `qrl train`; `qrl train --help` lists them
  make identify LOG=flight.csv VEHICLE=start.json   fit a vehicle's file to logs of its flights (LOG="a.csv b.csv")
       OUT=fitted.json                 the fitted vehicle's file; ARGS="--hold-out c.csv": any flag of `qrl identify`
  make evaluate RUN=runs/circle      fly 1,000 fresh starts: table, evaluation.json, plots
       ARGS=--off-nominal              any flag of `qrl evaluate`; "--beside runs/ppo": other runs too
  make export RUN=runs/circle        a C kernel for a microcontroller in RUN/export, verified bit for bit
       NAME=hover                      prefix of all its names in C (default qrl_TASK)
  make view RUN=runs/circle          flights of it in 3D as one HTML page, RUN/view.html, to open in a browser
       ARGS="--starts 12 900"          which of evaluate's starts, by index; --out FILE; --kernel: its flights, too
  make fly VEHICLE=mine.json         a policy that ships and flies any quadrotor, with yours: evaluate and view
       REFERENCE=eight                 what to follow; RUN=any: which run; ARGS="--starts 1000 --off-nominal"
  make sweep GRID=experiments/grids/pendulum_lr.json   train every point of a grid; rerun to resume
       OUT=runs/pendulum_lr            the folder of its results
       ARGS="--engine ray"             on a Ray cluster; any other flag of `qrl sweep`
  make seeds TASK=circle             train 100 seeds, a core each: how many fly, how soon, their spread; rerun to resume
       SEEDS=100 FIRST=100             how many, and the first; OUT=runs/seeds_circle
       ARGS="--preset circle_fast"     any flag of `qrl train`; --jobs N, --retry (seeds whose training failed)
  make figures                       the paper's six figures with captions, from runs that it makes and keeps
       FAST=1                          from shorter runs of fewer seeds
       ARGS="--only pendulum hover"    some of them; --fresh, --out FOLDER
  make ablation                      the paper's objectives side by side on pendulum and hover, as a table
       ARGS="--only pendulum"          one task; --fresh, --out FOLDER
  make gallery                       docs/gallery.md: the figures, the shipped presets' flights, ablation and bench
       FAST=1                          with the figures of FAST=1; ARGS="--out FOLDER", --fresh
  make bench                         timings beside other libraries, each in an environment of its own: downloads them
       ARGS="--only pendulum"          groups or contestants, as ARGS=--list names them; --seeds 5, --fresh
       ARGS="--only judges"            exported kernels in rotorpy and crazyflow, beside RAPTOR; --runs, --starts
  make gpu                           measure this machine's GPU, in 8 minutes; adds JAX for CUDA to .venv
       ARGS="--only acting hover"      some of its sections; --lanes, --budget-seconds 480, --any-device
  make test                          the tests (ARGS="-k vtrace": any flag of pytest; -n 0: in one process)
  make smoke                         every command end to end, on a CPU
  make lint                          ruff and basedpyright
  make docs                          the pages as a website in site/, links checked
  make stress                        the long fault and fuzz campaign, and the tests with the newest versions

TASK is a name, a path to a .json, or module:factory of your environment.
`make setup PYTHON=python3.12` picks the interpreter.
endef

help:
	$(info $(HELP))
	@:

# A shell word that stands for $1, whatever is in it; a flag $1 with the value $2 where there is one.
quoted = '$(subst ','\'',$1)'
flag = $(if $2,$1 $(call quoted,$2))
# Stop with one line, before anything is built, where the goal $1 lacks what it needs; $3 is how to call it.
need = $(if $(filter $1,$(MAKECMDGOALS)),$(if $2,,$(error $3)))

# What a run is comes from the command line alone: some systems, say, have a NAME in the environment.
$(foreach name,TASK VEHICLE UNCERTAINTY REFERENCE INIT CONFIG SEED SEEDS FIRST OUT RESUME LOG RUN NAME GRID FAST, \
	$(if $(filter environment,$(origin $(name))),$(eval undefine $(name))))

# A run's config.json names its own task.
$(call need,train,$(TASK)$(CONFIG),TASK is missing: make train TASK=circle ("make tasks" lists them))
$(call need,seeds,$(TASK),TASK is missing: make seeds TASK=circle ("make tasks" lists them))
$(call need,identify,$(LOG),LOG is missing: make identify LOG=flight.csv VEHICLE=start.json)
$(call need,identify,$(VEHICLE),VEHICLE is missing: make identify LOG=flight.csv VEHICLE=start.json)
$(call need,sweep,$(GRID),GRID is missing: make sweep GRID=experiments/grids/pendulum_lr.json)
$(call need,evaluate,$(RUN),RUN is missing: make evaluate RUN=runs/circle)
$(call need,export,$(RUN),RUN is missing: make export RUN=runs/circle)
$(call need,view,$(RUN),RUN is missing: make view RUN=runs/circle)
$(call need,fly,$(VEHICLE),VEHICLE is missing: make fly VEHICLE=mine.json)

train: $(STAMP)
	@exec $(QRL) train $(if $(TASK),$(call quoted,$(TASK))) $(call flag,--seed,$(SEED)) $(call flag,--seeds,$(SEEDS)) \
		$(call flag,--vehicle,$(VEHICLE)) $(call flag,--uncertainty,$(UNCERTAINTY)) \
		$(call flag,--reference,$(REFERENCE)) $(call flag,--out,$(OUT)) $(if $(filter-out 0,$(RESUME)),--resume) \
		$(call flag,--config,$(CONFIG)) $(call flag,--init,$(INIT)) $(ARGS)

# LOG is a list: its words are not quoted.
identify: $(STAMP)
	@exec $(QRL) identify $(LOG) $(call flag,--vehicle,$(VEHICLE)) $(call flag,--out,$(OUT)) $(ARGS)

evaluate: $(STAMP)
	@exec $(QRL) evaluate $(call quoted,$(RUN)) $(call flag,--reference,$(REFERENCE)) \
		$(call flag,--vehicle,$(VEHICLE)) $(ARGS)

# `export` is a directive of make itself where a line begins with it.
$(or export): $(STAMP)
	@exec $(QRL) export $(call quoted,$(RUN)) $(call flag,--name,$(NAME)) $(ARGS)

fly: $(STAMP)
	@exec $(QRL) fly $(call quoted,$(or $(RUN),any)) $(call flag,--reference,$(REFERENCE)) \
		$(call flag,--vehicle,$(VEHICLE)) $(ARGS)

view: $(STAMP)
	@exec $(QRL) view $(call quoted,$(RUN)) $(call flag,--reference,$(REFERENCE)) \
		$(call flag,--vehicle,$(VEHICLE)) $(ARGS)

sweep: $(STAMP)
	@exec $(QRL) sweep $(call quoted,$(GRID)) $(call flag,--out,$(OUT)) $(ARGS)

seeds: $(STAMP)
	@exec $(VENV)/bin/python -m experiments.seeds $(call quoted,$(TASK)) $(call flag,--seeds,$(SEEDS)) \
		$(call flag,--first,$(FIRST)) $(call flag,--out,$(OUT)) $(ARGS)

tasks: $(STAMP)
	@exec $(QRL) tasks $(ARGS)

figures: $(STAMP)
	@exec $(VENV)/bin/python -m experiments.figures.make $(if $(filter-out 0,$(FAST)),--fast) $(ARGS)

ablation: $(STAMP)
	@exec $(VENV)/bin/python -m experiments.figures.ablation $(ARGS)

gallery: $(STAMP)
	@exec $(VENV)/bin/python -m experiments.gallery.make $(if $(filter-out 0,$(FAST)),--fast) $(ARGS)

bench: $(STAMP)
	@exec $(VENV)/bin/python -m experiments.bench.run $(ARGS)

gpu: $(if $(findstring --any-device,$(ARGS)),$(STAMP),$(CUDA))
	@exec $(VENV)/bin/python -m experiments.gpu.run $(ARGS)

# Two processes, for two cores. Each begins with half of the tests, those of a
# file together, for they share what they train; one that is done takes over tests of the other.
WORKERS := -n 2 --dist worksteal

test: $(STAMP)
	@exec $(VENV)/bin/python -m pytest $(WORKERS) $(ARGS)

smoke: $(STAMP)
	@exec tests/smoke.sh

stress: $(STAMP)
	@exec tests/stress.sh

torture:
	@echo 'note: make torture is now make stress' >&2
	@$(MAKE) stress

# The generator is no dependency of qrl: it is installed when it is asked for. Not --quiet: strict mode then counts no
# warning, and a broken link passes.
docs: $(STAMP)
	@$(PIP) install -r docs/requirements.txt
	@NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build
	@echo 'site/index.html'

lint: $(STAMP)
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/basedpyright

setup: $(STAMP)
	@echo '$(VENV) is ready'

# ---- .venv -----------------------------------------------------------------------------------------------
# The stamp is taken away before pip begins and comes back last, so a .venv without one is what an interrupted
# set-up left: it is made anew, not patched. So is one that was moved here (its scripts name the place where it
# was made) or that has lost its interpreter or pyvenv.cfg; without that file its Python is the system's, and
# `--require-virtualenv` is the last guard against installing there.

here := test -x $(VENV)/bin/python && test -e $(VENV)/pyvenv.cfg && grep -qsF "$(CURDIR)/$(VENV)/" $(VENV)/bin/qrl
PIP := $(VENV)/bin/python -m pip --require-virtualenv --disable-pip-version-check -qq

# What is wrong with $(PYTHON), in a line, or nothing.
python_problem = $(shell $(PYTHON) -c 'import sys; from importlib import util; \
	v = sys.version_info; \
	v >= (3, 11) or sys.exit("$(PYTHON) is Python %d.%d, and qrl needs 3.11 or newer: make setup PYTHON=python3.12" % v[:2]); \
	util.find_spec("ensurepip") or sys.exit("$(PYTHON) lacks the venv module: apt-get install python3-venv")' \
	2>&1 | tail -n 1)
stop_on = $(if $1,$(error $1))

# The lock file is a lock in this sense too: a second make waits for the first, and finds nothing left to do.
$(STAMP): requirements.lock pyproject.toml $(shell $(here) || echo FORCE)
	$(call stop_on,$(python_problem))
	@set -e; exec 9<requirements.lock; \
	if command -v flock >/dev/null; then flock -n 9 || { echo 'waiting: another make is at $(VENV)'; flock 9; }; fi; \
	if test ! -e $@ || ! { $(here); }; then \
		echo 'making $(VENV) (once; a few minutes)'; \
		rm -f $@; rm -rf $(VENV); $(PYTHON) -m venv $(VENV); \
	elif test $@ -nt requirements.lock && test $@ -nt pyproject.toml; then exit 0; fi; \
	rm -f $@; \
	$(PIP) install -r requirements.lock; \
	$(PIP) install --no-deps -e .; \
	touch $@

# JAX for CUDA, in the version of the lock; gigabytes, so not without a card.
$(CUDA): $(STAMP)
	@test -e /dev/nvidiactl || test -e /dev/dxg || command -v nvidia-smi >/dev/null || { \
		echo 'gpu: expected an NVIDIA GPU with its driver; ARGS=--any-device measures what there is' >&2; exit 2; }
	@echo 'adding JAX for CUDA to $(VENV) (once; some minutes)'
	@rm -f $@
	@$(PIP) install -c requirements.lock -e '.[cuda]'
	@touch $@

FORCE:
