# Read by backup.sh and restore.sh: where the database is, as LVBA_DATABASE or LVBA_DATABASE_FILE say. Sets $url, empty for
# SQLite in the data folder; its password goes to PGPASSWORD, for command lines can be seen by others.
# shellcheck shell=sh
url=${LVBA_DATABASE:-}
if [ -z "$url" ] && [ -n "${LVBA_DATABASE_FILE:-}" ]; then
    url=$(cat "$LVBA_DATABASE_FILE")
fi
python=${PYTHON:-python3}

if [ -n "$url" ]; then
    password=$(URL=$url "$python" -c \
        'import os; from urllib.parse import *; print(unquote(urlsplit(os.environ["URL"]).password or ""))')
    if [ -n "$password" ]; then
        export PGPASSWORD="$password"
    fi
    url=$(printf '%s' "$url" | sed 's#^\([a-z]*\)+psycopg:#\1:#; s#^\([a-z]*://[^:/@]*\):[^@]*@#\1@#')
fi

fail() {
    printf '%s: %s\n' "$(basename "$0")" "$*" >&2
    exit 1
}

for program in rsync "$python" ${url:+pg_dump pg_restore psql}; do
    command -v "$program" >/dev/null || fail "$program is not installed"
done
