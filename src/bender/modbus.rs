//! A machine whose registers hold a staging area, a commit word and a status: the reference map and its like.

use super::caller::FOREIGN_LOOKS;
use super::contact::{Event, RulesError};
use super::link::{ActiveTable, Bender, LinkError};
use super::modbus_client::ModbusClient;
use super::open::Opener;
use super::plan;
use super::profile::Profile;
use super::registers::{ModbusMap, decode_status};
use super::wire::{Staged, Status, TableId, commit_image, payload_bytes, staging_image};

/// A bender behind Modbus.
pub struct ModbusLink {
    profile: Profile,
    map: ModbusMap,
    client: ModbusClient,
}

impl ModbusLink {
    /// A link that connects at its first use; `endpoint` is what the profile's transport takes. Where there is an `opener`, over
    /// the wires that it makes.
    pub fn new(
        profile: Profile,
        map: ModbusMap,
        endpoint: String,
        opener: Option<Opener>,
    ) -> Result<ModbusLink, RulesError> {
        let client = ModbusClient::new(profile.clone(), map.unit_id, endpoint, opener)?;
        Ok(ModbusLink { profile, map, client })
    }
}

impl Bender for ModbusLink {
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
        let mut wrong = String::new();
        for _ in 0..FOREIGN_LOOKS {
            let bytes = self.client.read(vec![plan::status(&self.profile, &self.map)]).await?;
            match decode_status(&self.profile, &self.map, &bytes) {
                Ok(status) => {
                    self.client.caller().has_seen();
                    return Ok(status);
                }
                Err(why) => wrong = why,
            }
        }
        self.client.caller().perform(Event::Foreign);
        Err(self.client.nonsense(wrong))
    }

    async fn write_staging(&mut self, staged: &Staged) -> Result<(), LinkError> {
        let image = staging_image(&self.profile, staged);
        let requests = plan::writes(&self.map, self.map.registers.staging, image.len());
        self.client.write(requests, &image).await
    }

    async fn read_staging(&mut self, bytes: usize) -> Result<Vec<u8>, LinkError> {
        self.client.read(plan::reads(&self.map, self.map.registers.staging, bytes)).await
    }

    async fn commit(&mut self, id: TableId) -> Result<(), LinkError> {
        self.client.write_once(self.map.registers.commit, &commit_image(&self.profile, id)).await
    }

    async fn read_active(&mut self) -> Result<ActiveTable, LinkError> {
        let status = self.read_status().await?;
        let (address, header) = (self.map.registers.active, self.profile.payload_header_bytes());
        if status.active.revision == 0 {
            return Ok(ActiveTable { status, payload: Vec::new() });
        }
        let mut payload = self.client.read(plan::reads(&self.map, address, header)).await?;
        let name = self.profile.table.program_bytes;
        let bends = usize::from(u16::from_be_bytes([payload[name], payload[name + 1]]));
        let most = self.profile.limits.max_bends;
        if bends > most {
            return Err(self
                .client
                .nonsense(format!("the active table says {bends} bends, its area has room for {most}")));
        }
        let rows = payload_bytes(&self.profile, bends) - header;
        payload.extend(
            self.client.read(plan::reads(&self.map, plan::rows(&self.profile, &self.map), rows)).await?,
        );
        ActiveTable::checked(status, payload).map_err(|why| self.client.nonsense(why))
    }
}
