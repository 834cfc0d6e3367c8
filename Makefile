.PHONY: check format

check:
	ruff check .
	ruff format --check .
	pyright
	pytest

format:
	ruff check --fix .
	ruff format .
