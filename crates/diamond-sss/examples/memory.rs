//! Predicted and measured peak memory of whole runs: `cargo run --release -p diamond-sss --example memory -- [ROWS]`.
//!
//! Writes captures of a ball, runs `diamond reconstruct` on each as a process of its own with as many Gaussians as it
//! may have from the first step on, and prints a row of a Markdown table.
#[path = "../tests/program/captures.rs"]
#[allow(dead_code)]
mod captures;

use std::process::Command;

fn main() {
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let program = std::env::current_exe().unwrap().parent().unwrap().join("../diamond");
    // Side, views, lights, lights of the held-out view, Gaussians, preset.
    let rows: [(u32, usize, usize, usize, usize, &str); 10] = [
        (64, 6, 4, 2, 1000, "resolved"),
        (128, 12, 8, 2, 4000, "resolved"),
        (128, 12, 8, 2, 40_000, "resolved"),
        (256, 12, 8, 8, 20_000, "resolved"),
        (256, 12, 8, 2, 70_000, "resolved"),
        (256, 6, 40, 40, 20_000, "resolved"),
        (512, 12, 8, 2, 20_000, "sss-3dgs"),
        (512, 12, 8, 8, 20_000, "resolved"),
        (512, 24, 16, 16, 70_000, "resolved"),
        (1024, 12, 8, 2, 50_000, "resolved"),
    ];
    println!(
        "| pixels | images | Gaussians | predicted, MiB | measured, MiB | ratio | measured after (planned for) each part, MiB |"
    );
    println!("|---|---|---|---|---|---|---|");
    for (row, (side, views, lights, held_out, gaussians, preset)) in rows.into_iter().enumerate() {
        if !wanted.is_empty() && !wanted.contains(&row.to_string()) {
            continue;
        }
        let dir = captures::scratch(&format!("memory-{row}"));
        captures::ball_capture(&dir.join("capture"), views, lights, side, held_out);
        let config = dir.join("memory.toml");
        let text = format!(
            "base = \"{preset}\"\nname = \"memory\"\n[initial]\ncount = {gaussians}\nhull_resolution = 192\n\
             [density]\nmax_gaussians = {gaussians}\nstrategy = \"none\"\n[subsurface]\nseeds = 0\n"
        );
        std::fs::write(&config, text).unwrap();
        let words = ["reconstruct", "capture", "-o", "out", "--preset", "memory.toml", "--steps", "30"];
        let output = Command::new(&program).args(words).current_dir(&dir).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let read = |name: &str| -> serde_json::Value {
            serde_json::from_str(&std::fs::read_to_string(dir.join("out").join(name)).unwrap()).unwrap()
        };
        let mebibytes = |v: &serde_json::Value| v.as_f64().unwrap_or(f64::NAN) / f64::from(1 << 20);
        let measured = mebibytes(&read("profile.json")["peak_bytes"]);
        let predicted = mebibytes(&read("needs.json")["memory"]["peak"]);
        let n = &read("metrics.json")["gaussians"];
        let after = &read("profile.json")["peak_bytes_after"];
        let moments = read("needs.json")["memory"]["moments"].clone();
        let planned = |part: &str| -> f64 {
            let moment = moments.as_array().into_iter().flatten().find(|m| m["name"] == part);
            moment.and_then(|m| m["parts"].as_array()).into_iter().flatten().map(|p| mebibytes(&p["bytes"])).sum()
        };
        println!(
            "| {preset}, {side}² | {} | {n} | {predicted:.0} | {measured:.0} | {:.2} | {} |",
            views * lights,
            predicted / measured,
            after
                .as_array()
                .into_iter()
                .flatten()
                .map(|p| (p[0].as_str().unwrap_or(""), mebibytes(&p[1])))
                .map(|(part, bytes)| format!("{part} {bytes:.0} ({:.0})", planned(part)))
                .collect::<Vec<_>>()
                .join(", ")
        );
        std::fs::remove_dir_all(dir).unwrap();
    }
}
