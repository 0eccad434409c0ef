#!/bin/sh
# What backup.sh has copied, into an empty place: restore.sh BACKUP DATA
# The service is not to run meanwhile; a PostgreSQL database (LVBA_DATABASE or LVBA_DATABASE_FILE) must be there and empty.
set -eu
umask 077
backup=${1:?usage: restore.sh BACKUP DATA}
data=${2:?usage: restore.sh BACKUP DATA}
# shellcheck source=database.sh
. "$(dirname "$0")/database.sh"

name=database.sqlite
if [ -n "$url" ]; then name=database.dump; fi
[ -f "$backup/$name" ] || fail "there is no $backup/$name: is it a copy of another kind of database?"
mkdir -p "$data"
[ -z "$(find "$data" -type f | head -n 1)" ] || fail "$data is not empty"
if [ -n "$url" ]; then
    tables=$(psql --no-psqlrc --tuples-only --no-align \
        --command="SELECT count(*) FROM information_schema.tables WHERE table_schema = 'public'" "$url")
    [ "$tables" = 0 ] || fail "the database is not empty"
fi

rsync --archive "$backup/files/" "$data/"
if [ -z "$url" ]; then
    cp "$backup/$name" "$data/lvba.sqlite"
else
    pg_restore --exit-on-error --single-transaction --no-owner --dbname="$url" "$backup/$name"
fi
printf 'restore.sh: done; start the service\n' >&2
