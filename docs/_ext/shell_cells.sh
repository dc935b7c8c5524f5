# Read by bash before each shell cell (BASH_ENV): the kernel asks programs for colours, which pages do not show.
unset FORCE_COLOR CLICOLOR CLICOLOR_FORCE
export TERM=dumb NO_COLOR=1 COLUMNS=96
