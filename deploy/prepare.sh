#!/bin/sh
# What must be there before the containers of a deployment start. What is there stays.
#   LVBA_TLS        certificates for LVBA_NAMES, by tls.sh
#   LVBA_SECRETS    the password of the database, and its URL
#   LVBA_DATA       the folders that workers are shown; may be left out
set -eu
umask 077

# shellcheck disable=SC2086
sh "$(dirname "$0")/tls.sh" "$LVBA_TLS" $LVBA_NAMES

if [ ! -s "$LVBA_SECRETS/database_url" ]; then
    password=$(openssl rand -hex 32)
    printf '%s\n' "$password" >"$LVBA_SECRETS/postgres_password"
    printf 'postgresql://lvba:%s@database/lvba\n' "$password" >"$LVBA_SECRETS/database_url"
fi

if [ -n "${LVBA_DATA:-}" ]; then
    mkdir -p "$LVBA_DATA/datasets" "$LVBA_DATA/jobs"
fi
