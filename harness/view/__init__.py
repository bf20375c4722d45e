"""Live view: a page on loopback that shows a recording while it grows.

    source     reads the file: the only thread that does
    session    state of the picture after each message, and the events for pages
    increments the whole picture, and its news since the last event
    presence   motors and nodes: state, heartbeat, faults
    identifiers messages on the buses: count, period, jitter, latest data
    stream     the latest events, by position in the record
    access     token, Host and Origin of requests
    desk       requests of pages for the rig, and its answers
    page_server HTTP: port, token, refusals
    server     the page, the events, the report, the requests
    campaign   the page and files of a swarm's folder
    page       the page's text

Only `source`, `desk` and servers touch time, threads and sockets. Everything on the page but its
hands comes from the record, so a file, a rig and a live bus share all code after the source.
"""
