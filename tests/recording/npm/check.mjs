// Reads an MCAP file front to back with every checksum validated, and by its index in log-time order.
// Prints one JSON object: {"streamed": {topic: count}, "indexed": {topic: count}, "schemas": {topic: name},
// "attachments": {name: text}, "metadata": {name: {key: value}}}. Ends with an error if the two ways differ.
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { createReadStream } from "node:fs";
import { open } from "node:fs/promises";

const CHUNK_BYTES = 4096;

/** Counts messages by topic, and keeps a digest of their order-independent content. */
class Tally {
  counts = {};
  lines = [];

  add(topic, message) {
    this.counts[topic] = (this.counts[topic] ?? 0) + 1;
    const { logTime, publishTime, sequence, data } = message;
    const digest = createHash("sha256").update(data).digest("hex");
    this.lines.push(`${topic} ${logTime} ${publishTime} ${sequence} ${digest}`);
  }

  content() {
    return this.lines.slice().sort();
  }
}

async function stream(path, decompressHandlers) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  const found = { tally: new Tally(), schemas: {}, attachments: {}, metadata: {} };
  const schemas = new Map();
  const topics = new Map();
  const take = (record) => {
    switch (record.type) {
      case "Schema":
        if (record.encoding === "jsonschema") JSON.parse(new TextDecoder().decode(record.data));
        assert(record.data.length > 0, `the schema of ${record.name} is empty`);
        schemas.set(record.id, record.name);
        break;
      case "Channel":
        topics.set(record.id, record.topic);
        found.schemas[record.topic] = schemas.get(record.schemaId) ?? null;
        break;
      case "Message":
        found.tally.add(topics.get(record.channelId), record);
        break;
      case "Attachment":
        found.attachments[record.name] = new TextDecoder().decode(record.data);
        break;
      case "Metadata":
        found.metadata[record.name] = Object.fromEntries(record.metadata);
        break;
    }
  };
  for await (const data of createReadStream(path, { highWaterMark: CHUNK_BYTES })) {
    reader.append(data);
    for (let record; (record = reader.nextRecord()); ) take(record);
  }
  assert(reader.done(), "the file goes on after its end");
  return found;
}

async function indexed(path, decompressHandlers) {
  const handle = await open(path, "r");
  try {
    const readable = new FileHandleReadable(handle);
    const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
    const tally = new Tally();
    let last = 0n;
    for await (const message of reader.readMessages({ validateCrcs: true })) {
      assert(message.logTime >= last, "the index is not in the order of log time");
      last = message.logTime;
      tally.add(reader.channelsById.get(message.channelId).topic, message);
    }
    assert.equal(reader.statistics.messageCount, BigInt(tally.lines.length));
    return tally;
  } finally {
    await handle.close();
  }
}

const path = process.argv[2];
const decompressHandlers = await loadDecompressHandlers();
const streamed = await stream(path, decompressHandlers);
const byIndex = await indexed(path, decompressHandlers);
assert.deepEqual(byIndex.content(), streamed.tally.content());
const { tally, ...rest } = streamed;
process.stdout.write(JSON.stringify({ streamed: tally.counts, indexed: byIndex.counts, ...rest }) + "\n");
