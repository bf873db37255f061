//! ELF: an executable for Arm with one loadable segment, no code and no entry.
//!
//! Flashing tools place the segment by its physical address; debuggers find the policy by the symbol `gadm_policy`.
//! Source: System V ABI, chapters 4 and 5; ELF for the Arm Architecture (machine number and ABI version in the flags).

use object::elf::{
    EF_ARM_EABI_VER5, ELFOSABI_NONE, EM_ARM, ET_EXEC, PF_R, PT_LOAD, SHF_ALLOC, SHN_UNDEF, SHT_PROGBITS, STB_GLOBAL,
    STT_OBJECT, STV_DEFAULT, SymbolInfo,
};
use object::read::elf::{FileHeader, ProgramHeader};
use object::write::elf::{FileHeader as NewHeader, ProgramHeader as NewSegment, SectionHeader, Sym, Writer};
use object::{Endianness, FileKind};

use crate::{ADDRESS_ALIGN, Format, ImageError, Segment};

pub(crate) fn encode(address: u32, bytes: &[u8]) -> Result<Vec<u8>, ImageError> {
    let failed = |error: object::write::Error| ImageError::ElfWrite(error.to_string());
    let mut content = Vec::new();
    let mut writer = Writer::new(Endianness::Little, false, &mut content);
    let align = u64::from(ADDRESS_ALIGN);
    let size = bytes.len() as u64;

    // The writer wants everything reserved in the order in which it is written.
    let section_name = writer.add_section_name(b".gadm_policy");
    let symbol_name = writer.add_string(b"gadm_policy");
    writer.reserve_file_header();
    writer.reserve_program_headers(1);
    writer.reserve_null_section_index();
    let section = writer.reserve_section_index();
    let offset = writer.reserve(size, align);
    writer.reserve_null_symbol_index();
    writer.reserve_symbol_index(Some(section));
    writer.reserve_symtab_section_index();
    writer.reserve_symtab();
    writer.reserve_strtab_section_index();
    writer.reserve_strtab().map_err(failed)?;
    writer.reserve_shstrtab_section_index();
    writer.reserve_shstrtab().map_err(failed)?;
    writer.reserve_section_headers();

    writer
        .write_file_header(&NewHeader {
            os_abi: ELFOSABI_NONE,
            abi_version: 0,
            e_type: ET_EXEC,
            e_machine: EM_ARM,
            e_entry: 0,
            e_flags: EF_ARM_EABI_VER5,
        })
        .map_err(failed)?;
    writer.write_align_program_headers();
    let p_addr = u64::from(address);
    writer.write_program_header(&NewSegment {
        p_type: PT_LOAD,
        p_flags: PF_R,
        p_offset: offset,
        p_vaddr: p_addr,
        p_paddr: p_addr,
        p_filesz: size,
        p_memsz: size,
        p_align: align,
    });
    writer.write_align(align);
    writer.write(bytes);
    writer.write_null_symbol();
    writer.write_symbol(&Sym {
        st_name: writer.string_offset(Some(symbol_name)),
        section: Some(section.0),
        st_info: SymbolInfo::new(STB_GLOBAL, STT_OBJECT),
        st_other: STV_DEFAULT.into(),
        st_shndx: SHN_UNDEF,
        st_value: p_addr,
        st_size: size,
    });
    writer.write_strtab();
    writer.write_shstrtab();
    writer.write_null_section_header();
    writer.write_section_header(&SectionHeader {
        sh_name: writer.section_name_offset(Some(section_name)),
        sh_type: SHT_PROGBITS,
        sh_flags: SHF_ALLOC,
        sh_addr: p_addr,
        sh_offset: offset,
        sh_size: size,
        sh_link: 0,
        sh_info: 0,
        sh_addralign: align,
        sh_entsize: 0,
    });
    writer.write_symtab_section_header(1);
    writer.write_strtab_section_header();
    writer.write_shstrtab_section_header();
    Ok(content)
}

/// The loadable segments at their physical addresses; of any 32- or 64-bit file, so that a whole firmware can be read.
pub(crate) fn decode(content: &[u8]) -> Result<Vec<Segment>, ImageError> {
    match FileKind::parse(content) {
        Ok(FileKind::Elf32) => segments::<object::elf::FileHeader32<Endianness>>(content),
        Ok(FileKind::Elf64) => segments::<object::elf::FileHeader64<Endianness>>(content),
        Ok(other) => Err(damaged("its start", &format!("{other:?} is no ELF"))),
        Err(error) => Err(damaged("its start", &error)),
    }
}

fn segments<Elf: FileHeader<Endian = Endianness>>(content: &[u8]) -> Result<Vec<Segment>, ImageError> {
    let header = Elf::parse(content).map_err(|error| damaged("its header", &error))?;
    let endian = header.endian().map_err(|error| damaged("its header", &error))?;
    let list = header.program_headers(endian, content).map_err(|error| damaged("its program headers", &error))?;
    let mut segments = Vec::new();
    for (index, part) in list.iter().enumerate().filter(|(_, part)| part.p_type(endian) == PT_LOAD) {
        let place = format!("segment {index}");
        let bytes = part.data(endian, content).map_err(|()| damaged(&place, &"it ends beyond the file"))?;
        let address =
            u32::try_from(part.p_paddr(endian).into()).map_err(|_| damaged(&place, &"address beyond 32 bits"))?;
        segments.push(Segment { address, bytes: bytes.to_vec() });
    }
    if segments.is_empty() {
        return Err(damaged("its program headers", &"no loadable segment (an object file must be linked first)"));
    }
    Ok(segments)
}

fn damaged(place: &str, what: &dyn std::fmt::Display) -> ImageError {
    ImageError::Damaged { format: Format::Elf, place: place.to_owned(), what: what.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comes_back_and_is_refused_when_cut_off() {
        let bytes: Vec<u8> = (0..160).collect();
        let content = encode(0x0806_0000, &bytes).unwrap();
        assert_eq!(decode(&content).unwrap(), [Segment { address: 0x0806_0000, bytes }]);
        let error = decode(&content[..120]).unwrap_err().to_string();
        assert!(error.contains("ELF") && error.contains("beyond the file"), "{error}");
        let error = decode(&content[..20]).unwrap_err().to_string();
        assert!(error.contains("its header"), "{error}");
    }
}
