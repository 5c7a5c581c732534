#!/bin/sh
# A certificate authority of one's own, and certificates from it: for the server, and for the three clients that
# server.json5 knows by name, `operator` (moves tools), `observer` (listens only) and `recorder` (listens, and has the server record).
#
#   sh make_certificates.sh [FOLDER [NAME...]]          (default: certificates server operator observer recorder)
#
# The name `server` gives a certificate to serve with, as localhost: put the names that clients connect to in its place
# below. Any other gives a client's, with which nobody can pose as the server.
# An authority that is already there is kept, so that a certificate can be added later.
# Keep authority.key away from the machines that run clients: who has it can make operators.
set -eu
folder=${1:-certificates}
if [ $# -gt 0 ]; then shift; fi
if [ $# -eq 0 ]; then set -- server operator observer recorder; fi
mkdir -p "$folder"
cd "$folder"
umask 077
if [ ! -e authority.key ]; then
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 3650 \
        -subj "/CN=palpate authority" -keyout authority.key -out authority.pem 2>/dev/null
fi
for name in "$@"; do
    if [ "$name" = server ]; then
        purpose='extendedKeyUsage=serverAuth\nsubjectAltName=DNS:localhost,IP:127.0.0.1'
    else
        purpose='extendedKeyUsage=clientAuth'
    fi
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes \
        -subj "/CN=$name" -keyout "$name.key" -out "$name.csr" 2>/dev/null
    printf "basicConstraints=CA:FALSE\n$purpose\n" > "$name.ext"
    openssl x509 -req -in "$name.csr" -CA authority.pem -CAkey authority.key -CAcreateserial -days 825 \
        -extfile "$name.ext" -out "$name.pem" 2>/dev/null
    rm "$name.csr" "$name.ext"
done
