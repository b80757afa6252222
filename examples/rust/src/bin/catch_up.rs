//! Prints every record of a shore site once, also those missed: catch_up tcp/127.0.0.1:7447 [CURSOR]

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use zenoh::query::ConsolidationMode;

const KEY: &str = "sonarpost/v1/shore/contact/*/*";

type Error = Box<dyn std::error::Error + Send + Sync>;

fn unpack(bytes: &[u8]) -> Result<rmpv::Value, Error> {
    Ok(rmpv::decode::read_value(&mut &bytes[..])?)
}

/// The records printed so far: all up to the cursor, and some above it.
#[derive(Default)]
struct Printed {
    cursor: String,
    ahead: BTreeSet<u64>,
}

impl Printed {
    fn reached(&self) -> u64 {
        self.cursor
            .split_once('.')
            .and_then(|(_, seq)| seq.parse().ok())
            .unwrap_or(0)
    }

    /// Print a record, unless it was printed before; return its number.
    fn show(&self, record: &rmpv::Value) -> Result<u64, Error> {
        let seq = record["accepted"]["seq"]
            .as_u64()
            .ok_or("a record without number")?;
        if seq > self.reached() && !self.ahead.contains(&seq) {
            let text = |name: &str| record[name].as_str().unwrap_or("-").to_string();
            println!(
                "{seq} {} {} {} {} {}",
                text("type"),
                text("vehicle_id"),
                text("image_id"),
                record["version"].as_u64().map_or("-".into(), |v| v.to_string()),
                text("verdict")
            );
        }
        Ok(seq)
    }

    /// Query the records after the cursor and print them; return whether more remain, None without a complete page.
    async fn next_page(&mut self, session: &zenoh::Session) -> Result<Option<bool>, Error> {
        let replies = session
            .get(format!("{KEY}?after={}", self.cursor))
            // Otherwise Zenoh keeps only the last reply of each key.
            .consolidation(ConsolidationMode::None)
            .timeout(Duration::from_secs(30))
            .await?;
        // By number: if several c2 of one archive reply, each sends the same records and a page.
        let (mut records, mut page) = (BTreeMap::new(), None::<rmpv::Value>);
        while let Ok(reply) = replies.recv_async().await {
            match reply.into_result() {
                Ok(sample) => {
                    let record = unpack(&sample.payload().to_bytes())?;
                    if record["type"].as_str() != Some("page") {
                        let seq = record["accepted"]["seq"].as_u64();
                        records.insert(seq.ok_or("a record without number")?, record);
                    } else if page.as_ref().is_none_or(|p| p["records"].as_u64() < record["records"].as_u64()) {
                        page = Some(record);
                    }
                }
                Err(error) => {
                    let text = error.payload().try_to_string()?.into_owned();
                    // Zenoh reports a time-out as an error, too.
                    if text.contains(": got ") && !text.contains(": busy: ") {
                        return Err(text.into());
                    }
                }
            }
        }
        // c2 is away or busy, or a reply was lost.
        let Some(page) = page.filter(|page| page["records"].as_u64() == Some(records.len() as u64)) else {
            return Ok(None);
        };
        for record in records.values() {
            self.show(record)?;
        }
        self.cursor = page["next"].as_str().ok_or("a page without cursor")?.into();
        self.ahead = self.ahead.split_off(&(self.reached() + 1));
        Ok(page["more"].as_bool())
    }
}

#[tokio::main]
async fn main() -> Result<(), Error> {
    let mut arguments = std::env::args().skip(1);
    let router = arguments.next().ok_or("usage: catch_up ENDPOINT [CURSOR]")?;
    let mut printed = Printed {
        cursor: arguments.next().unwrap_or_default(),
        ..Default::default()
    };
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", r#""client""#)?;
    config.insert_json5("connect/endpoints", &format!("[{router:?}]"))?;
    let session = zenoh::open(config).await?;
    // Before the first query: what is published during the queries waits here.
    let (sender, mut live) = tokio::sync::mpsc::unbounded_channel();
    let _subscriber = session
        .declare_subscriber(KEY)
        .callback(move |sample| {
            let _ = sender.send(sample);
        })
        .await?;
    loop {
        // First everything missed, then publications for 30 s, then again what was lost on the way.
        let mut more = Some(true);
        while more == Some(true) {
            more = printed.next_page(&session).await?;
        }
        eprintln!("cursor {}", printed.cursor);
        let pause = Duration::from_secs(if more.is_none() { 1 } else { 30 });
        let until = tokio::time::Instant::now() + pause;
        while let Ok(Some(sample)) = tokio::time::timeout_at(until, live.recv()).await {
            let seq = printed.show(&unpack(&sample.payload().to_bytes())?)?;
            printed.ahead.insert(seq);
        }
    }
}
