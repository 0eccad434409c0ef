#!/bin/sh
# Certificates of a deployment: tls.sh FOLDER NAME...      NAME: a host name or an address by which browsers call it
#
#   FOLDER/authority   the keys of two authorities: keep it where no service can read it
#   FOLDER/cluster     ca.pem, node.pem, node.key: whoever has them may join the cluster and run code on its workers
#   FOLDER/web         server.pem, server.key for the proxy; ca.pem, to be trusted by browsers
#
# What is good for another month stays as it is, and so does a certificate in FOLDER/web that somebody else has signed.
set -eu
umask 077

folder=$1
shift
month=2592000
names="$*"

say() { printf 'tls: %s\n' "$*" >&2; }

authority() {
    # $1: cluster or web
    key=$folder/authority/$1.key
    pem=$folder/authority/$1.pem
    if ! openssl x509 -in "$pem" -noout -checkend "$month" >/dev/null 2>&1; then
        openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 -subj "/CN=lvba $1 authority" \
            -addext keyUsage=critical,keyCertSign,cRLSign -keyout "$key" -out "$pem" 2>/dev/null
        say "made $pem"
    fi
    cp "$pem" "$folder/$1/ca.pem"
}

certificate() {
    # $1: authority; $2: file without ending; $3: what it is for; $4: its names
    file=$folder/$1/$2
    extensions=$folder/$1/.extensions
    printf '%s\n' "basicConstraints=CA:FALSE" "keyUsage=critical,digitalSignature" "extendedKeyUsage=$3" \
        "subjectKeyIdentifier=hash" "authorityKeyIdentifier=keyid" "subjectAltName=$4" >"$extensions"
    openssl req -new -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=lvba $1" \
        -keyout "$file.key.new" -out "$file.csr" 2>/dev/null
    openssl x509 -req -in "$file.csr" -days 397 -CA "$folder/authority/$1.pem" -CAkey "$folder/authority/$1.key" \
        -set_serial "0x01$(openssl rand -hex 15)" -extfile "$extensions" -out "$file.pem.new" 2>/dev/null
    mv "$file.key.new" "$file.key"
    mv "$file.pem.new" "$file.pem"
    rm "$file.csr" "$extensions"
    say "made $file.pem"
}

foreign() {
    # $1: authority; $2: a certificate that it has not signed
    [ -s "$2" ] && ! openssl x509 -in "$2" -noout -issuer | grep -q "lvba $1 authority"
}

good() {
    # $1: authority; $2: file without ending
    pem=$folder/$1/$2.pem
    openssl verify -CAfile "$folder/authority/$1.pem" "$pem" >/dev/null 2>&1 &&
        openssl x509 -in "$pem" -noout -checkend "$month" >/dev/null &&
        [ "$(openssl x509 -in "$pem" -noout -pubkey)" = "$(openssl pkey -in "$folder/$1/$2.key" -pubout 2>/dev/null)" ]
}

is_address() {
    case $1 in
    *:* | *[0-9].[0-9]*.[0-9]*.[0-9]*) case $1 in *[!0-9a-fA-F:.]*) return 1 ;; esac ;;
    *) return 1 ;;
    esac
}

named() {
    # whether the certificate $1 is good for all names
    for name in $names; do
        check=-checkhost
        if is_address "$name"; then check=-checkip; fi
        openssl x509 -in "$1" -noout "$check" "$name" | grep -q "does match" || return 1
    done
}

alternative_names() {
    list=
    for name in $names; do
        kind=DNS
        if is_address "$name"; then kind=IP; fi
        list=$list${list:+,}$kind:$name
    done
    printf '%s' "$list"
}

if [ -z "$names" ]; then
    say "usage: tls.sh FOLDER NAME..."
    exit 2
fi
mkdir -p "$folder/authority" "$folder/cluster" "$folder/web"
authority cluster
good cluster node || certificate cluster node serverAuth,clientAuth DNS:lvba
if foreign web "$folder/web/server.pem"; then
    say "$folder/web/server.pem is somebody else's and stays"
else
    authority web
    { good web server && named "$folder/web/server.pem"; } || certificate web server serverAuth "$(alternative_names)"
fi
