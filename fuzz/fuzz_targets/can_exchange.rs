//! Tables over CAN and CAN FD on a bus where anything happens to frames: every exchange ends, a commit goes out once, and where nothing
//! happened what is read is what the machine has.

#![no_main]

use std::sync::{Arc, LazyLock};

use benderd::bender::can::FrameId;
use benderd::bender::{Ask, CanSettings, CanTable, Profile, Protocol as _, Transport};
use benderd::sim::can_station::CanStation;
use benderd_fuzz::Script;
use benderd_fuzz::bus::{Bus, ask};
use libfuzzer_sys::fuzz_target;

static PROFILES: LazyLock<[Profile; 2]> = LazyLock::new(|| {
    let folder = std::env::temp_dir().join(format!("benderd-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let fd = folder.join("fd.toml");
    let text = include_str!("../../protocols/reference-can.toml").replacen("fd = false", "fd = true", 1);
    std::fs::write(&fd, text).unwrap();
    let profiles = ["reference-can", fd.to_str().unwrap()].map(|name| Profile::load(name).unwrap());
    std::fs::remove_dir_all(&folder).unwrap();
    profiles
});

fn settings(profile: &Profile) -> CanSettings {
    let Transport::Can(settings) = &profile.transport else { panic!() };
    CanSettings { contract: Arc::clone(&settings.contract), fd: settings.fd }
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script::new(data);
    let profile = &PROFILES[usize::from(script.any() % 2)];
    let ids = vec![0x310, 0x311, 0x321, 0x323, 0x325, 0x320];
    let mut bus = Bus::new(profile, CanStation::new(), ids, &mut script);
    let ask = ask(&mut script);
    let exchange = CanTable::new(profile, &settings(profile), None).begin(&ask);
    let answer = bus.run(exchange, &mut script);
    let commits = bus.sent.iter().filter(|frame| frame.id == FrameId::Standard(0x322)).count();
    assert_eq!(commits, usize::from(matches!(ask, Ask::Commit(_))));
    bus.check(profile, &ask, answer);
});
