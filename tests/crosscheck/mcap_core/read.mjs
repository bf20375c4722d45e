// Reads a recording with @mcap/core, twice: as a stream, every CRC checked, and by its indexes.
// Prints as JSON the messages of each topic, SHA-256 over all (topic, log time, payload) in the
// order they were written, and what else there is in the file.
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";
import { createHash } from "node:crypto";
import { open, readFile } from "node:fs/promises";

const path = process.argv[2];
const decompressHandlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };

async function asStream() {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  const told = { messages: {}, metadata: [], attachments: [], kinds: {} };
  const topics = new Map();
  const hash = createHash("sha256");
  reader.append(await readFile(path));
  for (let record; (record = reader.nextRecord()); ) {
    told.kinds[record.type] = (told.kinds[record.type] ?? 0) + 1;
    if (record.type === "Channel") topics.set(record.id, record.topic);
    if (record.type === "Metadata") told.metadata.push(record.name);
    if (record.type === "Attachment") told.attachments.push(record.name);
    if (record.type !== "Message") continue;
    const topic = topics.get(record.channelId);
    told.messages[topic] = (told.messages[topic] ?? 0) + 1;
    const name = Buffer.from(topic);
    const head = Buffer.alloc(4 + name.length + 12);
    head.writeUInt32LE(name.length, 0);
    name.copy(head, 4);
    head.writeBigUInt64LE(record.logTime, 4 + name.length);
    head.writeUInt32LE(record.data.length, 12 + name.length);
    hash.update(head).update(record.data);
  }
  return { ...told, done: reader.done(), digest: hash.digest("hex") };
}

async function byIndexes() {
  const file = await open(path);
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, size) => {
      const buffer = new Uint8Array(Number(size));
      await file.read(buffer, 0, buffer.length, Number(offset));
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const messages = {};
  let backward = 0;
  let before = 0n;
  for await (const message of reader.readMessages()) {
    const topic = reader.channelsById.get(message.channelId).topic;
    messages[topic] = (messages[topic] ?? 0) + 1;
    backward += message.logTime < before ? 1 : 0;
    before = message.logTime;
  }
  await file.close();
  const counted = Number(reader.statistics.messageCount);
  return { messages, backward, counted, chunks: reader.chunkIndexes.length };
}

console.log(JSON.stringify({ stream: await asStream(), indexed: await byIndexes() }));
