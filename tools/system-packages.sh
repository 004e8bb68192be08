#!/usr/bin/env bash
# Installs the packages of system-packages.txt that are missing, when it may (root or password-less sudo);
# otherwise stops with the one line to type. Optional ones are skipped, with a note, where apt has no candidate.
set -euo pipefail
cd "$(dirname "$0")"
missing=()
optional=()
while read -r package mark; do
  dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' && continue
  if [ "$mark" = optional ]; then optional+=("$package"); else missing+=("$package"); fi
done < <(grep -vE '^(#|$)' system-packages.txt)
[ $((${#missing[@]} + ${#optional[@]})) -eq 0 ] && exit 0
if ! command -v apt-get >/dev/null; then
  [ ${#missing[@]} -eq 0 ] && exit 0
  echo "set-up: this is not Debian or Ubuntu; install the equivalents of: ${missing[*]}" >&2
  exit 1
fi
# A here-string, not a pipe: grep stops reading at the first match, and pipefail would blame apt-cache for that.
has_candidate() { grep -qE '^ *Candidate: [^(]' <<<"$(apt-cache policy "$1" 2>/dev/null)"; }
# Adds the optional packages that apt can install to the missing ones.
choose_optional() {
  local package
  for package in ${optional[@]+"${optional[@]}"}; do
    if has_candidate "$package"; then
      missing+=("$package")
    else
      echo "set-up: $package is not in this distribution; going on without it (optional)"
    fi
  done
}
if [ "$(id -u)" -eq 0 ]; then
  as_root=()
elif sudo -n true 2>/dev/null; then
  as_root=(sudo)
else
  choose_optional
  [ ${#missing[@]} -eq 0 ] && exit 0
  echo "set-up needs system packages; type:  sudo apt-get install -y --no-install-recommends ${missing[*]}" >&2
  exit 1
fi
# Only a machine that lacks something asks the network.
${as_root[@]+"${as_root[@]}"} apt-get update -qq || [ ${#missing[@]} -eq 0 ]
choose_optional
[ ${#missing[@]} -eq 0 ] && exit 0
echo "set-up: installing ${missing[*]}"
DEBIAN_FRONTEND=noninteractive ${as_root[@]+"${as_root[@]}"} apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
