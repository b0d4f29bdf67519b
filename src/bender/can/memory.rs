//! A CAN bus in memory: what one node sends all others receive. Interfaces can be made to go bus-off, to jam, to vanish.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

use super::bus::Bus;
use super::frame::{Condition, Frame, Heard};

/// What waits to be sent on an interface that cannot, at most: a Linux interface's usual `txqueuelen`.
const SENDING: usize = 10;

/// What waits to be received, at most; what comes then is lost, as with a socket.
const RECEIVED: usize = 1000;

/// A bus; its clones are the same one.
#[derive(Clone, Default)]
pub struct MemoryBus {
    wires: Arc<Mutex<Wires>>,
}

#[derive(Default)]
struct Wires {
    nodes: BTreeMap<u64, Place>,
    next: u64,
    /// Interfaces that cannot send now, and what waits there.
    held: BTreeMap<String, Vec<Frame>>,
    vanished: BTreeSet<String>,
}

struct Place {
    interface: String,
    queue: VecDeque<Heard>,
    waker: Option<Waker>,
}

impl Place {
    fn hear(&mut self, heard: Heard) {
        if self.queue.len() < RECEIVED {
            self.queue.push_back(heard);
        }
        self.wake();
    }

    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }
}

impl Wires {
    fn on<'a>(&'a mut self, interface: &'a str) -> impl Iterator<Item = &'a mut Place> {
        self.nodes.values_mut().filter(move |place| place.interface == interface)
    }

    /// To all but the interface that it comes from, and those that are off the bus.
    fn carry(&mut self, from: &str, frame: &Frame) {
        let held = &self.held;
        let places = self.nodes.values_mut();
        places
            .filter(|place| place.interface != from && !held.contains_key(&place.interface))
            .for_each(|place| place.hear(Heard::Frame(frame.clone())));
    }
}

impl MemoryBus {
    /// A bus without nodes.
    pub fn new() -> MemoryBus {
        MemoryBus::default()
    }

    fn wires(&self) -> MutexGuard<'_, Wires> {
        self.wires.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A new node behind an interface; it leaves when it is dropped. Nodes behind one interface do not hear each other.
    pub fn join(&self, interface: &str) -> io::Result<MemoryNode> {
        let mut wires = self.wires();
        if wires.vanished.contains(interface) {
            return Err(io::Error::from_raw_os_error(libc::ENODEV));
        }
        let number = wires.next;
        wires.next += 1;
        let place = Place { interface: interface.to_owned(), queue: VecDeque::new(), waker: None };
        wires.nodes.insert(number, place);
        Ok(MemoryNode { bus: self.clone(), number })
    }

    /// An interface sends and hears nothing any more; its nodes are told.
    pub fn bus_off(&self, interface: &str) {
        let mut wires = self.wires();
        wires.on(interface).for_each(|place| place.hear(Heard::Condition(Condition::BusOff)));
        wires.held.insert(interface.to_owned(), Vec::new());
    }

    /// The end of that; what waited to be sent is lost.
    pub fn restart(&self, interface: &str) {
        let mut wires = self.wires();
        wires.held.remove(interface);
        wires.on(interface).for_each(|place| place.hear(Heard::Condition(Condition::Restarted)));
    }

    /// Nobody acknowledges what an interface sends: it waits.
    pub fn jam(&self, interface: &str) {
        self.wires().held.insert(interface.to_owned(), Vec::new());
    }

    /// The end of that; what waited goes out.
    pub fn clear(&self, interface: &str) {
        let mut wires = self.wires();
        for frame in wires.held.remove(interface).unwrap_or_default() {
            wires.carry(interface, &frame);
        }
    }

    /// Something is wrong on the bus; the nodes of an interface are told.
    pub fn disturb(&self, interface: &str, condition: Condition) {
        self.wires().on(interface).for_each(|place| place.hear(Heard::Condition(condition)));
    }

    /// An adapter is pulled out.
    pub fn vanish(&self, interface: &str) {
        let mut wires = self.wires();
        wires.vanished.insert(interface.to_owned());
        wires.on(interface).for_each(Place::wake);
    }

    /// And plugged in again; who used it must join anew.
    pub fn reappear(&self, interface: &str) {
        let mut wires = self.wires();
        wires.nodes.retain(|_, place| {
            if place.interface == interface {
                place.wake();
            }
            place.interface != interface
        });
        wires.vanished.remove(interface);
    }
}

/// A node.
pub struct MemoryNode {
    bus: MemoryBus,
    number: u64,
}

impl MemoryNode {
    /// What is known of it, as long as its interface is there.
    fn place<'a>(&self, wires: &'a mut Wires) -> io::Result<&'a mut Place> {
        let Wires { nodes, vanished, .. } = wires;
        let place = nodes.get_mut(&self.number).filter(|place| !vanished.contains(&place.interface));
        place.ok_or_else(|| io::Error::from_raw_os_error(libc::ENODEV))
    }
}

impl Bus for MemoryNode {
    fn poll_send(&mut self, _: &mut Context<'_>, frame: &Frame) -> Poll<io::Result<()>> {
        if !Frame::is_possible_length(frame.data.len()) {
            return Poll::Ready(Err(io::Error::from_raw_os_error(libc::EINVAL)));
        }
        let mut wires = self.bus.wires();
        let interface = match self.place(&mut wires) {
            Ok(place) => place.interface.clone(),
            Err(error) => return Poll::Ready(Err(error)),
        };
        match wires.held.get_mut(&interface) {
            Some(waiting) if waiting.len() >= SENDING => {
                return Poll::Ready(Err(io::Error::from_raw_os_error(libc::ENOBUFS)));
            }
            Some(waiting) => waiting.push(frame.clone()),
            None => wires.carry(&interface, frame),
        }
        Poll::Ready(Ok(()))
    }

    fn poll_receive(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<Heard>> {
        let mut wires = self.bus.wires();
        let place = match self.place(&mut wires) {
            Ok(place) => place,
            Err(error) => return Poll::Ready(Err(error)),
        };
        match place.queue.pop_front() {
            Some(heard) => Poll::Ready(Ok(heard)),
            None => {
                place.waker = Some(cx.waker().clone());
                Poll::Pending
            }
        }
    }
}

impl Drop for MemoryNode {
    fn drop(&mut self) {
        self.bus.wires().nodes.remove(&self.number);
    }
}
