#!/bin/sh
# A copy of everything, while the service serves and jobs run: backup.sh DATA BACKUP
#   BACKUP/database.sqlite or BACKUP/database.dump, and BACKUP/files
# Given again, it copies what has changed. Cut short, it leaves the copy before usable. Options for rsync: RSYNC_OPTIONS,
# for example --exclude=/jobs/*/out/stages
set -eu
umask 077
data=${1:?usage: backup.sh DATA BACKUP}
backup=${2:?usage: backup.sh DATA BACKUP}
# shellcheck source=database.sh
. "$(dirname "$0")/database.sh"

copy() {
    # shellcheck disable=SC2086
    rsync --archive --exclude='/lvba.sqlite*' --exclude=/instances --exclude=/trash ${RSYNC_OPTIONS:-} "$@" \
        "$data/" "$backup/files/" || [ $? = 24 ] # some files were removed meanwhile
}

[ -d "$data/jobs" ] || fail "$data is not the data folder of a service"
mkdir -p "$backup/files"

# the database first: whatever its copy knows is then among the files
if [ -z "$url" ]; then
    name=database.sqlite
    rm -f "$backup/$name.new"
    "$python" -c '
import sqlite3, sys
source, target = (sqlite3.connect(f"file:{path}?mode=rw{new}", uri=True) for path, new in zip(sys.argv[1:], ("", "c")))
source.backup(target)
found = target.execute("PRAGMA integrity_check").fetchone()[0]
target.execute("PRAGMA journal_mode=DELETE")
sys.exit(0 if found == "ok" else f"the copy of the database is damaged: {found}")
' "$data/lvba.sqlite" "$backup/$name.new"
else
    name=database.dump
    pg_dump --format=custom --file="$backup/$name.new" "$url"
    pg_restore --list "$backup/$name.new" >/dev/null
fi
copy
mv "$backup/$name.new" "$backup/$name"
# only now may go what the copy before still knew
copy --delete
printf 'backup.sh: %s and %s files in %s\n' "$name" "$(find "$backup/files" -type f | wc -l)" "$backup" >&2
