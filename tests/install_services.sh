#!/usr/bin/env bash
# Installs PostgreSQL, which the slow tests of the services need, where it is missing and that can be done.
set -u
command -v initdb >/dev/null && exit 0
compgen -G "/usr/lib/postgresql/*/bin/initdb" >/dev/null && exit 0
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
  echo "no PostgreSQL: tests of the services fail"
  exit 0
fi
export DEBIAN_FRONTEND=noninteractive
{ apt-get update -qq && apt-get install -y -qq --no-install-recommends postgresql; } >/dev/null 2>&1 ||
  echo "PostgreSQL cannot be installed: tests of the services fail"
exit 0
