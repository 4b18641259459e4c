"""A guest kernel with CAN: runs commands on a real vcan0 where the machine's own kernel has none.

`image` knows and fetches what the guest is made of, `session` boots it for one command, `init.sh` is its process 1,
`command` is `parkctl guest`.
"""
