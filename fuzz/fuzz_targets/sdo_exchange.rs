//! Tables by SDO, in blocks and in segments, on a bus where anything happens to frames: every exchange ends, a commit is begun once, and
//! where nothing happened what is read is what the machine has.

#![no_main]

use std::sync::LazyLock;

use benderd::bender::{Ask, Canopen, CanopenSettings, Profile, Protocol as _, Transport};
use benderd::sim::sdo_server::SdoServer;
use benderd_fuzz::Script;
use benderd_fuzz::bus::{Bus, ask};
use libfuzzer_sys::fuzz_target;

static PROFILE: LazyLock<Profile> = LazyLock::new(|| Profile::load("reference-canopen").unwrap());

/// The commit's object as a frame has it.
const COMMIT: [u8; 3] = [0x02, 0x20, 0x00];

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let Transport::Canopen(settings) = &PROFILE.transport else { panic!() };
    let how = script.any();
    let settings = CanopenSettings { block: how & 1 == 0, ..settings.clone() };
    let server = if how & 2 == 0 { SdoServer::new } else { SdoServer::without_blocks };
    let mut bus = Bus::new(&PROFILE, server(settings.clone()), vec![0x585, 0x605, 0x584], &mut script);
    let ask = ask(&mut script);
    let exchange = Canopen::new(&PROFILE, &settings, None).begin(&ask);
    let answer = bus.run(exchange, &mut script);
    assert!(bus.sent.iter().all(|frame| frame.data.len() == 8), "a frame of SDO has eight bytes");
    let begun = bus.sent.iter().filter(|frame| frame.data[0] >> 5 == 1 && frame.data[1..4] == COMMIT).count();
    assert_eq!(begun, usize::from(matches!(ask, Ask::Commit(_))));
    bus.check(&PROFILE, &ask, answer);
});
