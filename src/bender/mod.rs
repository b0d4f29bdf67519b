//! The machine: profiles, links, and the stage-verify-commit handshake, the only gate to it.
