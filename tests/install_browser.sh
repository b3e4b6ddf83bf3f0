#!/usr/bin/env bash
# Installs the browser that the tests of HTML pages need, where that can be done; without it they are skipped.
set -u
for name in chromium chromium-browser google-chrome; do
  command -v "$name" >/dev/null && exit 0
done
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
  echo "no chromium: tests of HTML pages are skipped"
  exit 0
fi
export DEBIAN_FRONTEND=noninteractive
{ apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium; } >/dev/null 2>&1 ||
  echo "chromium cannot be installed: tests of HTML pages are skipped"
exit 0
