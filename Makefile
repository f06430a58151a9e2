.PHONY: demo test test-long test-slow test-wheel docs gallery check-site format check bench xr clean
.DEFAULT_GOAL := help

PYTHON := .venv/bin/python
OUT ?= outputs/demo
SHELF ?= middle
ROBOT ?= panda
PYTHONS ?= 3.12
# Importing all other tests would take longer than these.
REALTIME = $(shell grep -rl --include="test_*.py" "mark.realtime" tests)

help:
	@echo "make demo    demonstrate, learn, grasp, place in simulation; writes $(OUT)"
	@echo "             make demo SHELF=upper places on another shelf (lower, middle, upper)"
	@echo "             make demo ROBOT=xarm7 does it with another arm (ur5, ur5e, iiwa7, fr3, ...)"
	@echo "make test    run the tests        make test-long  whole jobs and browsers as well"
	@echo "make xr      build the client for headsets and phones"
	@echo "make bench   measure the speed against floors and peers"
	@echo "make docs    build the documentation site; writes outputs/docs"
	@echo "make gallery make the pictures of the site; ONLY=\"film dmp_pose\": only these"
	@echo "make check-site  check every page of the built site in a browser"
	@echo "make format  format the code        make check  lint, type-check, build the site"

demo: .venv/.installed
	$(PYTHON) -m hrc_learn.cli demo --out $(OUT) --shelf $(SHELF) --robot $(ROBOT)

# Rewritten assertions and checked shapes are compiled once, not by each worker and program.
test test-long test-slow: export PYTHONDONTWRITEBYTECODE =
test: .venv/.installed
	$(PYTHON) -m pytest -n auto --dist loadfile -m "not slow and not long and not realtime"
	@# Each file in a process of its own: nodes and threads that one leaves would slow the next.
	@# A machine that does something else meanwhile may stall for longer than a protocol allows.
	@# Pytest exits with 5 where all tests of a file are slow as well.
	for file in $(REALTIME); do \
	  $(PYTHON) -m pytest -q -m "realtime and not slow" $$file || [ $$? = 5 ] \
	  || $(PYTHON) -m pytest --last-failed -m "realtime and not slow" $$file || exit 1; \
	done

test-long: .venv/.installed
	$(PYTHON) -m pytest -n auto --dist loadfile -m "long and not slow"

test-slow: .venv/.installed
	$(PYTHON) -m pytest -m slow

# PYTHONS="3.12 3.13" tests with both; uv fetches a Python that is missing.
test-wheel: .venv/.installed
	$(PYTHON) tools/test_wheel.py --python $(PYTHONS)

docs: .venv/.installed
	$(PYTHON) tools/build_docs.py

gallery: .venv/.installed
	$(PYTHON) tools/build_gallery.py $(if $(ONLY),--only $(ONLY))

check-site: .venv/.installed
	$(PYTHON) tools/check_site.py

format: .venv/.installed
	$(PYTHON) -m ruff check --fix-only --quiet .
	$(PYTHON) -m ruff format .
	$(PYTHON) tools/measure_code.py hrc_learn --update

check: .venv/.installed
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) tools/measure_code.py hrc_learn --check
	$(PYTHON) -m pyright
	$(PYTHON) tools/build_docs.py

xr: .venv/.installed
	$(PYTHON) tools/build_xr.py

bench: .venv/.installed
	for program in benchmarks/bench_*.py; do $(PYTHON) $$program || exit 1; done

clean:
	rm -rf .venv outputs

.venv/.installed: pyproject.toml constraints.txt tools/make_venv.sh
	bash tools/make_venv.sh
	touch $@
