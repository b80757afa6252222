//! Prints the records of a shore site: shore_subscriber tcp/127.0.0.1:7447

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let router = std::env::args()
        .nth(1)
        .ok_or("usage: shore_subscriber ENDPOINT")?;
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", r#""client""#)?;
    config.insert_json5("connect/endpoints", &format!("[{router:?}]"))?;
    let session = zenoh::open(config).await?;
    let subscriber = session
        .declare_subscriber("sonarpost/v1/shore/contact/**")
        .await?;
    while let Ok(sample) = subscriber.recv_async().await {
        let payload = sample.payload().to_bytes();
        let Ok(record) = rmpv::decode::read_value(&mut &payload[..]) else {
            eprintln!("{}: no msgpack", sample.key_expr());
            continue;
        };
        let text = |name: &str| record[name].as_str().unwrap_or("-").to_string();
        println!(
            "{} {} {} {}",
            text("type"),
            text("vehicle_id"),
            text("image_id"),
            text("verdict")
        );
        if let Some(pixels) = record["pixels"]["data"].as_slice() {
            let (height, width) = (
                &record["pixels"]["height_px"],
                &record["pixels"]["width_px"],
            );
            println!(
                "  {height} x {width} px, {} bytes, at {} {}",
                pixels.len(),
                record["contact"]["lat_deg"],
                record["contact"]["lon_deg"]
            );
        }
    }
    Ok(())
}
