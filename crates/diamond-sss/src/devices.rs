//! What this machine has to compute on, as a table for people.
use diamond_gpu::{Adapter, DeviceKind};
use std::fmt::Write;

/// The CPU and every device with a driver, one line each, and what they are used for.
pub fn devices_text() -> String {
    table(&diamond_gpu::adapters(), rayon::current_num_threads())
}

fn table(adapters: &[Adapter], threads: usize) -> String {
    let mut text = format!("cpu     {threads} threads: reconstructs and renders\n");
    for a in adapters {
        let use_of =
            if a.kind == DeviceKind::Software { "for tests only, slower than cpu" } else { "trains and renders" };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "gpu:{}   {}, {}, {}, driver {}; arrays of at most {} MiB{}{}: {use_of}",
            a.index,
            a.name,
            a.kind.name(),
            a.backend,
            if a.driver.is_empty() { "unknown" } else { &a.driver },
            a.max_binding >> 20,
            if a.subgroups { ", subgroups" } else { "" },
            if a.half { ", f16" } else { "" },
        );
    }
    if adapters.is_empty() {
        text += "no GPU: no driver for Vulkan, Metal or Direct3D 12 was found\n";
    }
    text += "diamond reconstruct --device gpu:N makes training steps there, diamond render pictures; rays and density control run on the CPU\n";
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_device_has_a_line_and_none_is_said() {
        let adapter = Adapter {
            index: 0,
            name: "Card".into(),
            kind: DeviceKind::Discrete,
            backend: "vulkan".into(),
            driver: "driver 1.2".into(),
            max_binding: 1 << 31,
            max_buffer: 1 << 33,
            workgroup_memory: 1 << 15,
            subgroups: true,
            half: false,
        };
        let text = table(&[adapter.clone(), Adapter { index: 1, kind: DeviceKind::Software, ..adapter }], 2);
        assert!(
            text.contains("gpu:0   Card, discrete, vulkan, driver driver 1.2; arrays of at most 2048 MiB, subgroups:")
        );
        assert!(text.lines().nth(2).is_some_and(|line| line.starts_with("gpu:1") && line.contains("tests only")));
        assert!(table(&[], 1).contains("no GPU"));
    }
}
