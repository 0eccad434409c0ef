#!/bin/sh
# Lints what is in this folder; the tools are those of `pip install "lvba[check]"`. Schemas and meaning: tests/deploy.
set -eu
cd "$(dirname "$0")"
shellcheck --external-sources ./*.sh
hadolint Containerfile
yamllint --strict -c .yamllint.yaml .
check-jsonschema --quiet --builtin-schema vendor.compose-spec compose.yaml
