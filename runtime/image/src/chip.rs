//! Chips by name: their erase blocks and how flashing tools call them.

use crate::Bank;

/// A microcontroller with its flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chip {
    /// Name for `--chip`, in small letters.
    pub name: &'static str,
    /// The part and flash size that the numbers are for.
    pub part: &'static str,
    /// Other names: family members with the same blocks, boards.
    pub aliases: &'static [&'static str],
    /// Erase blocks by rising address.
    pub banks: &'static [Bank],
    /// Address that the core starts from: the policy must not lie there.
    pub boot: u32,
    /// Where the erase blocks are written down.
    pub source: &'static str,
    /// UF2 family number. Source: microsoft/uf2, `utils/uf2families.json`.
    pub uf2_family: u32,
    /// Name for `probe-rs --chip`.
    pub probe_rs: &'static str,
    /// Target file of OpenOCD.
    pub openocd_target: &'static str,
    /// Interface file of OpenOCD for the probe that comes with the usual board.
    pub openocd_interface: &'static str,
    /// Whether its ROM boot loader speaks USB DFU with addresses (`DfuSe`).
    pub dfu: bool,
}

const KIB: u32 = 1024;

const fn bank(start: u32, block: u32, count: u32) -> Bank {
    Bank { start, block, count }
}

const STLINK: &str = "interface/stlink.cfg";
const CMSIS_DAP: &str = "interface/cmsis-dap.cfg";

/// The chips that are known by name.
pub const CHIPS: &[Chip] = &[
    Chip {
        name: "stm32f405",
        part: "STM32F405RG, 1 MiB",
        aliases: &["stm32f405rg", "stm32f407", "stm32f407vg", "netduinoplus2"],
        banks: &[bank(0x0800_0000, 16 * KIB, 4), bank(0x0801_0000, 64 * KIB, 1), bank(0x0802_0000, 128 * KIB, 7)],
        boot: 0x0800_0000,
        source: "ST RM0090, embedded Flash memory, sectors of STM32F40x",
        uf2_family: 0x5775_5A57,
        probe_rs: "STM32F405RGTx",
        openocd_target: "target/stm32f4x.cfg",
        openocd_interface: STLINK,
        dfu: true,
    },
    Chip {
        name: "stm32f411",
        part: "STM32F411RE, 512 KiB",
        aliases: &["stm32f411re"],
        banks: &[bank(0x0800_0000, 16 * KIB, 4), bank(0x0801_0000, 64 * KIB, 1), bank(0x0802_0000, 128 * KIB, 3)],
        boot: 0x0800_0000,
        source: "ST RM0383, embedded Flash memory, sectors",
        uf2_family: 0x5775_5A57,
        probe_rs: "STM32F411RETx",
        openocd_target: "target/stm32f4x.cfg",
        openocd_interface: STLINK,
        dfu: true,
    },
    Chip {
        name: "stm32f446",
        part: "STM32F446RE, 512 KiB",
        aliases: &["stm32f446re"],
        banks: &[bank(0x0800_0000, 16 * KIB, 4), bank(0x0801_0000, 64 * KIB, 1), bank(0x0802_0000, 128 * KIB, 3)],
        boot: 0x0800_0000,
        source: "ST RM0390, embedded Flash memory, sectors",
        uf2_family: 0x5775_5A57,
        probe_rs: "STM32F446RETx",
        openocd_target: "target/stm32f4x.cfg",
        openocd_interface: STLINK,
        dfu: true,
    },
    Chip {
        name: "stm32f767",
        part: "STM32F767ZI, 2 MiB, one bank (factory setting)",
        aliases: &["stm32f767zi"],
        banks: &[bank(0x0800_0000, 32 * KIB, 4), bank(0x0802_0000, 128 * KIB, 1), bank(0x0804_0000, 256 * KIB, 7)],
        boot: 0x0800_0000,
        source: "ST RM0410, embedded Flash memory, 2 MiB single bank",
        uf2_family: 0x53B8_0F00,
        probe_rs: "STM32F767ZITx",
        openocd_target: "target/stm32f7x.cfg",
        openocd_interface: STLINK,
        dfu: true,
    },
    Chip {
        name: "stm32h743",
        part: "STM32H743ZI, 2 MiB",
        aliases: &["stm32h743zi"],
        banks: &[bank(0x0800_0000, 128 * KIB, 16)],
        boot: 0x0800_0000,
        source: "ST RM0433, embedded Flash memory, two banks of eight sectors",
        uf2_family: 0x6DB6_6082,
        probe_rs: "STM32H743ZITx",
        openocd_target: "target/stm32h7x_dual_bank.cfg",
        openocd_interface: STLINK,
        dfu: true,
    },
    Chip {
        name: "stm32g474",
        part: "STM32G474RE, 512 KiB, two banks (factory setting)",
        aliases: &["stm32g474re"],
        banks: &[bank(0x0800_0000, 2 * KIB, 256)],
        boot: 0x0800_0000,
        source: "ST RM0440, embedded Flash memory, category 3 devices with DBANK = 1",
        uf2_family: 0x4C71_240A,
        probe_rs: "STM32G474RETx",
        openocd_target: "target/stm32g4x.cfg",
        openocd_interface: STLINK,
        dfu: true,
    },
    Chip {
        name: "stm32l476",
        part: "STM32L476RG, 1 MiB",
        aliases: &["stm32l476rg"],
        banks: &[bank(0x0800_0000, 2 * KIB, 512)],
        boot: 0x0800_0000,
        source: "ST RM0351, embedded Flash memory, pages of 2 KiB",
        uf2_family: 0x00FF_6919,
        probe_rs: "STM32L476RGTx",
        openocd_target: "target/stm32l4x.cfg",
        openocd_interface: STLINK,
        dfu: true,
    },
    Chip {
        name: "rp2040",
        part: "RP2040 with 2 MiB of serial flash (Raspberry Pi Pico)",
        aliases: &["pico"],
        banks: &[bank(0x1000_0000, 4 * KIB, 512)],
        boot: 0x1000_0000,
        source: "Raspberry Pi Pico C SDK, hardware_flash: FLASH_SECTOR_SIZE; Pico data sheet: 2 MiB",
        uf2_family: 0xE48B_FF56,
        probe_rs: "RP2040",
        openocd_target: "target/rp2040.cfg",
        openocd_interface: CMSIS_DAP,
        dfu: false,
    },
    Chip {
        name: "nrf52840",
        part: "nRF52840, 1 MiB",
        aliases: &[],
        banks: &[bank(0, 4 * KIB, 256)],
        boot: 0,
        source: "Nordic nRF52840 product specification, memory and NVMC: code page size",
        uf2_family: 0xADA5_2840,
        probe_rs: "nRF52840_xxAA",
        openocd_target: "target/nrf52.cfg",
        openocd_interface: CMSIS_DAP,
        dfu: false,
    },
];

/// The chip of this name or alias; letters may be large or small.
#[must_use]
pub fn chip(name: &str) -> Option<&'static Chip> {
    let name = name.to_ascii_lowercase();
    CHIPS.iter().find(|chip| chip.name == name || chip.aliases.contains(&name.as_str()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_found_once_and_in_any_case() {
        assert_eq!(chip("STM32F407VG").unwrap().name, "stm32f405");
        assert!(chip("z80").is_none());
        let names: Vec<_> = CHIPS.iter().flat_map(|c| std::iter::once(&c.name).chain(c.aliases)).collect();
        for (index, name) in names.iter().enumerate() {
            assert!(!names[..index].contains(name), "{name} twice");
            assert_eq!(**name, name.to_ascii_lowercase());
        }
    }

    #[test]
    fn blocks_follow_each_other_and_add_up_to_the_flash() {
        for chip in CHIPS {
            let mut at = u64::from(chip.boot);
            for bank in chip.banks {
                assert_eq!(u64::from(bank.start), at, "{}", chip.name);
                at += u64::from(bank.block) * u64::from(bank.count);
            }
            let mib = |text: &str| chip.part.contains(text);
            let expected = if mib(" 2 MiB") {
                2 << 20
            } else if mib("1 MiB") {
                1 << 20
            } else {
                512 << 10
            };
            assert_eq!(at - u64::from(chip.boot), expected, "{}", chip.name);
        }
    }
}
