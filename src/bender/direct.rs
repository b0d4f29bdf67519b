//! A machine without staging area, revision and acknowledgement: rows of 16-bit numbers that are in force as soon as they are written
//! (`handshake = "direct"`). The map of small PLCs.
//!
//! Nothing protects such a machine from half a table but the state bits before and the rows read back after; so every write needs the
//! operator's approval. The rows stand in three columns of the same length; what is behind the last bend is 0. The machine knows
//! neither the program nor the length after the last bend: both are 0 in the payload that stands for its table here.

use super::caller::FOREIGN_LOOKS;
use super::contact::{Event, RulesError};
use super::link::{ActiveTable, Bender, LinkError};
use super::modbus_client::ModbusClient;
use super::open::Opener;
use super::plan;
use super::profile::Profile;
use super::wire::{Ack, Staged, Status, TableId, crc_of, staging_image};

/// Where things are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DirectMap {
    /// Unit identifier.
    pub unit_id: u8,
    /// u16 that must hold the profile's constant: no other machine, no other die.
    pub identification: u16,
    /// First of 16 coils that are the state.
    pub state_coils: u16,
    /// How many coils there are.
    pub coils: u16,
    /// First register of length, rotation, angle; as many as the machine has rows.
    pub columns: [u16; 3],
}

/// The only revision that there is: such a machine always holds a table, and does not count them.
const REVISION: u32 = 1;

/// A bender whose rows are written directly.
pub struct DirectLink {
    profile: Profile,
    map: DirectMap,
    client: ModbusClient,
    /// What would be the staging area.
    staged: Vec<u8>,
}

impl DirectLink {
    /// A link that connects at its first use, over the wires of `opener` where there is one.
    pub fn new(
        profile: Profile,
        map: DirectMap,
        endpoint: String,
        opener: Option<Opener>,
    ) -> Result<DirectLink, RulesError> {
        let client = ModbusClient::new(profile.clone(), map.unit_id, endpoint, opener)?;
        Ok(DirectLink { profile, map, client, staged: Vec::new() })
    }

    fn rows(&self) -> u16 {
        self.profile.limits.max_bends as u16
    }

    /// The rows as a payload.
    async fn payload(&mut self) -> Result<Vec<u8>, LinkError> {
        let mut columns = Vec::new();
        for request in plan::columns(&self.profile, &self.map, false) {
            columns.push(self.client.read(vec![request]).await?);
        }
        let mut payload = vec![0; self.profile.payload_header_bytes()];
        payload[self.profile.table.program_bytes..][..2].copy_from_slice(&self.rows().to_be_bytes());
        for row in 0..usize::from(self.rows()) {
            for column in &columns {
                let number = i16::from_be_bytes([column[2 * row], column[2 * row + 1]]);
                payload.extend(i32::from(number).to_be_bytes());
            }
        }
        Ok(payload)
    }

    /// The constant is the profile's; one wrong look may be damage.
    async fn identify(&mut self) -> Result<(), LinkError> {
        let (at, expected) = (self.map.identification, self.profile.identification);
        let mut found = 0;
        for _ in 0..FOREIGN_LOOKS {
            let bytes = self.client.read(vec![plan::constant(&self.map)]).await?;
            found = u32::from(u16::from_be_bytes([bytes[0], bytes[1]]));
            if found == expected {
                return Ok(());
            }
        }
        self.client.caller().perform(Event::Foreign);
        Err(self.client.nonsense(format!(
            "register {at} holds {found} where profile {:?} expects {expected}: not this machine, or another die",
            self.profile.name
        )))
    }

    async fn status(&mut self, crc: u32) -> Result<Status, LinkError> {
        let state = self.client.read_coils(self.map.state_coils, self.map.coils).await?;
        self.client.caller().has_seen();
        Ok(Status {
            heartbeat: 0,
            state,
            program: String::new(),
            bend_count: self.rows(),
            active: TableId { revision: REVISION, crc },
            ack_revision: 0,
            ack: Ack::None,
            pending: TableId::default(),
        })
    }
}

impl Bender for DirectLink {
    fn profile(&self) -> &Profile {
        &self.profile
    }

    fn endpoint(&self) -> &str {
        self.client.endpoint()
    }

    fn reset(&mut self) {
        self.client.caller().perform(Event::Reset);
    }

    fn last_frames(&self) -> Vec<String> {
        self.client.frames().lines()
    }

    async fn read_status(&mut self) -> Result<Status, LinkError> {
        Ok(self.read_active().await?.status)
    }

    async fn write_staging(&mut self, staged: &Staged) -> Result<(), LinkError> {
        self.staged = staging_image(&self.profile, staged);
        Ok(())
    }

    async fn read_staging(&mut self, bytes: usize) -> Result<Vec<u8>, LinkError> {
        Ok(self.staged[..bytes.min(self.staged.len())].to_vec())
    }

    /// Each column in one request, once. When one fails, the rows read back show how far it came.
    async fn commit(&mut self, _: TableId) -> Result<(), LinkError> {
        let rows = self.staged.split_off(self.staged.len().min(8 + self.profile.payload_header_bytes()));
        for (i, address) in self.map.columns.into_iter().enumerate() {
            // The gate has seen that 16 bits hold them.
            let column: Vec<u8> = rows
                .chunks_exact(Profile::ROW_BYTES)
                .flat_map(|row| [row[4 * i + 2], row[4 * i + 3]])
                .collect();
            self.client.write_once(address, &column).await?;
        }
        Ok(())
    }

    /// Who it is comes first: another machine's rows mean nothing. The rows before and after the state must be the same: nobody was
    /// writing.
    async fn read_active(&mut self) -> Result<ActiveTable, LinkError> {
        self.identify().await?;
        let payload = self.payload().await?;
        let status = self.status(crc_of(&payload)).await?;
        if self.payload().await? != payload {
            return Err(self.client.nonsense("the rows changed while they were read".into()));
        }
        Ok(ActiveTable { status, payload })
    }
}
